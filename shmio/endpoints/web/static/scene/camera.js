// A camera that turns around a point, and how mouse, touch and keyboard move it.

import { add, cross, lookAt, perspective, subtract, unit } from "./matrix.js";

/** @typedef {import("./matrix.js").Vector} Vector */
/** @typedef {{ target: Vector, distance: number, azimuth: number, elevation: number }} View Lengths in m, angles in rad. */

export const FIELD_OF_VIEW = (36 * Math.PI) / 180;
const STEEPEST = (89 * Math.PI) / 180;
const TURN = 0.006; // rad for each pixel
const KEY_TURN = 0.09;

export class Camera {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    this.radius = 1;
    /** @type {View} */
    this.home = { target: [0, 0, 0], distance: 1, azimuth: 0, elevation: 0 };
    this.view = this.home;
    /** @type {Map<number, { x: number, y: number }>} */
    this.pointers = new Map();
  }

  /**
   * Look at a scene. If the camera looks at one already, it stays where it is.
   *
   * @param {number} radius Radius of the scene in m, which bounds the distance.
   * @param {View} home From where it is seen first.
   */
  frame(radius, home) {
    const stays = this.view !== this.home;
    this.radius = radius;
    this.home = home;
    if (!stays) this.view = home;
  }

  /** @returns {Vector} Where the camera is. */
  get eye() {
    const { target, distance, azimuth, elevation } = this.view;
    const flat = Math.cos(elevation);
    return add(target, [flat * Math.cos(azimuth), flat * Math.sin(azimuth), Math.sin(elevation)], distance);
  }

  /** @param {number} aspect Width by height of the picture. */
  matrices(aspect) {
    const { target, distance } = this.view;
    const near = Math.max(0.01, 0.02 * distance);
    return {
      view: lookAt(this.eye, target, [0, 0, 1]),
      projection: perspective(FIELD_OF_VIEW, aspect, near, distance + 6 * this.radius + 10),
    };
  }

  /** @param {Partial<View>} change */
  set(change) {
    const view = { ...this.view, ...change };
    view.elevation = Math.max(-STEEPEST, Math.min(STEEPEST, view.elevation));
    view.distance = Math.max(0.02 * this.radius, Math.min(12 * this.radius, view.distance));
    this.view = view;
    this.changed();
  }

  reset() {
    this.view = this.home;
    this.changed();
  }

  /** @param {number} right In pixels. @param {number} down In pixels. */
  turn(right, down) {
    this.set({ azimuth: this.view.azimuth - TURN * right, elevation: this.view.elevation + TURN * down });
  }

  /** Move the target, so that the picture follows the pointer. @param {number} right @param {number} down @param {number} height Of the picture, in pixels. */
  pan(right, down, height) {
    const { target, distance } = this.view;
    const metres = (2 * Math.tan(FIELD_OF_VIEW / 2) * distance) / height;
    const back = unit(subtract(this.eye, target));
    const sideways = unit(cross([0, 0, 1], back));
    const above = cross(back, sideways);
    this.set({ target: add(add(target, sideways, -right * metres), above, down * metres) });
  }

  /** @param {number} factor */
  zoom(factor) {
    this.set({ distance: this.view.distance * factor });
  }

  /**
   * Let the user move the camera: drag to turn, with the right button or Shift to move, wheel or two fingers to zoom.
   *
   * @param {HTMLElement} area
   */
  listen(area) {
    area.addEventListener("contextmenu", (event) => event.preventDefault());
    area.addEventListener("pointerdown", (event) => {
      this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      area.setPointerCapture(event.pointerId);
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
      area.addEventListener(end, (event) => this.pointers.delete(/** @type {PointerEvent} */ (event).pointerId));
    area.addEventListener("pointermove", (event) => this.drag(event, area.clientHeight));
    area.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1);
        this.zoom(Math.exp(0.0015 * Math.max(-300, Math.min(300, pixels))));
      },
      { passive: false },
    );
    area.addEventListener("dblclick", () => this.reset());
    area.addEventListener("keydown", (event) => {
      if (this.key(event.key, event.shiftKey, area.clientHeight)) event.preventDefault();
    });
  }

  /** @param {PointerEvent} event @param {number} height */
  drag(event, height) {
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = { x: event.clientX, y: event.clientY };
    const [right, down] = [now.x - before.x, now.y - before.y];
    this.pointers.set(event.pointerId, now);
    if (this.pointers.size > 1) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1] ?? before;
      const [old, fresh] = [before, now].map((point) => Math.hypot(point.x - other.x, point.y - other.y));
      if (old > 0 && fresh > 0) this.zoom(old / fresh);
      this.pan(right / 2, down / 2, height);
    } else if (event.buttons & 6 || event.shiftKey) this.pan(right, down, height);
    else this.turn(right, down);
  }

  /** @param {string} key @param {boolean} shift @param {number} height @returns {boolean} Whether the key means something. */
  key(key, shift, height) {
    /** @type {Record<string, [number, number]>} */
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[key];
    if (arrow && shift) this.pan(-0.05 * height * arrow[0], -0.05 * height * arrow[1], height);
    else if (arrow) this.turn((-arrow[0] * KEY_TURN) / TURN, (-arrow[1] * KEY_TURN) / TURN);
    else if (key === "+" || key === "=") this.zoom(0.85);
    else if (key === "-") this.zoom(1 / 0.85);
    else if (key === "Home" || key === "0") this.reset();
    else return false;
    return true;
  }
}
