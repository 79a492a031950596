// Where the bodies of a scene are, given the values of the registers that move them.

import { identity, multiply, placement, rotation, translation, unit } from "./matrix.js";

/** @typedef {import("./matrix.js").Matrix} Matrix */
/** @typedef {import("./matrix.js").Vector} Vector */
/**
 * @typedef {{ type: "revolute" | "prismatic", register: string, axis: Vector, unit: "deg" | "rad" | "mm" | "m", scale: number,
 *   offset: number, smooth_s: number }} Joint
 */
/**
 * @typedef {{ name: string, label: string, parent: number, position_mm: Vector, rotation_deg: Vector, joint: Joint | null,
 *   shapes: import("./mesh.js").Shape[] }} Body A body comes after its parent; -1 is none.
 */
/** @typedef {"good" | "injected" | "bad"} State How far the place of a body can be trusted. */

const UNITS = { deg: Math.PI / 180, rad: 1, mm: 0.001, m: 1 };
const STILL = 1e-6;
/** @type {State[]} */
const STATES = ["good", "injected", "bad"];

export class Kinematics {
  /** @param {Body[]} bodies */
  constructor(bodies) {
    this.bodies = bodies;
    this.places = bodies.map((body) => placement(body.position_mm, body.rotation_deg));
    this.axes = bodies.map((body) => unit(body.joint?.axis ?? [0, 0, 1]));
    /** Present values of the joints in m or rad; NaN before the first. */
    this.positions = bodies.map(() => NaN);
    /** Matrices from each body to the world. @type {Matrix[]} */
    this.world = bodies.map(identity);
    /** @type {State[]} */
    this.states = bodies.map(() => "good");
    this.solve();
  }

  /**
   * Move the joints.
   *
   * @param {(register: string) => number} value Returns the value of a register; NaN keeps the joint where it is.
   * @param {number} elapsedS Time since the last call.
   * @returns {boolean} Whether a body has moved.
   */
  move(value, elapsedS) {
    let moved = false;
    this.bodies.forEach(({ joint }, index) => {
      if (joint === null) return;
      const wanted = (joint.offset + joint.scale * value(joint.register)) * UNITS[joint.unit];
      if (!Number.isFinite(wanted)) return;
      const present = this.positions[index];
      const share = Number.isNaN(present) || joint.smooth_s === 0 ? 1 : 1 - Math.exp((-3 * elapsedS) / joint.smooth_s);
      const next = share === 1 || Math.abs(wanted - present) < STILL ? wanted : present + share * (wanted - present);
      if (Math.abs(next - present) < STILL && next !== wanted) return;
      moved ||= next !== present;
      this.positions[index] = next;
    });
    if (moved) this.solve();
    return moved;
  }

  /**
   * Set which bodies can be trusted. A body that hangs on another one inherits its state, because it is where that one takes it.
   *
   * @param {(register: string) => State} state Returns the state of a register.
   * @returns {boolean} Whether a state has changed.
   */
  judge(state) {
    let changed = false;
    this.bodies.forEach(({ joint, parent }, index) => {
      const own = joint === null ? 0 : STATES.indexOf(state(joint.register));
      const inherited = parent < 0 ? 0 : STATES.indexOf(this.states[parent]);
      const found = STATES[Math.max(own, inherited)];
      changed ||= found !== this.states[index];
      this.states[index] = found;
    });
    return changed;
  }

  solve() {
    this.bodies.forEach(({ joint, parent }, index) => {
      let place = this.places[index];
      const position = this.positions[index];
      if (joint !== null && !Number.isNaN(position)) {
        const axis = this.axes[index];
        const motion = joint.type === "revolute" ? rotation(axis, position) : translation(axis.map((part) => part * position));
        place = multiply(place, motion);
      }
      this.world[index] = parent < 0 ? place : multiply(this.world[parent], place);
    });
  }
}
