// Makes the triangles of a body's shapes.

import { placement, transform } from "./matrix.js";

/** @typedef {import("./matrix.js").Vector} Vector */
/** @typedef {import("./matrix.js").Matrix} Matrix */
/**
 * @typedef {{ form: "box" | "cylinder" | "sphere", size_mm: Vector | null, radius_mm: number | null, top_radius_mm: number | null,
 *   length_mm: number | null, along: "x" | "y" | "z" | null, round_mm: number | null, position_mm: Vector, rotation_deg: Vector, color: string }} Shape
 *   As shmio/config/scene.py has it.
 */
/**
 * @typedef {{ vertices: Float32Array, colors: Uint8Array, indices: Uint32Array, low: Vector, high: Vector }} Mesh Six numbers of each
 *   vertex: position in m, and normal. `low` and `high` are the corners of the box around it.
 */
/** @typedef {[number, number, number, number]} Ring Radius and height of a ring of vertices, and radius and height of their normal. */

const CORNER_STEPS = 4;
const RINGS = 24;

/**
 * @param {Shape[]} shapes
 * @returns {Mesh}
 */
export function makeMesh(shapes) {
  const builder = new Builder();
  for (const shape of shapes) {
    builder.begin(placement(shape.position_mm, shape.rotation_deg), shape.along ?? "z", shape.color);
    const round = (shape.round_mm ?? 0) / 1000;
    const radius = (shape.radius_mm ?? 0) / 1000;
    if (shape.form === "box") addBox(builder, (shape.size_mm ?? [0, 0, 0]).map((length) => length / 2000), round);
    else if (shape.form === "sphere") addLathe(builder, arc(0, 0, radius, -90, 90, RINGS), radius);
    else addCylinder(builder, radius, (shape.top_radius_mm ?? shape.radius_mm ?? 0) / 1000, (shape.length_mm ?? 0) / 2000, round);
  }
  return builder.mesh();
}

class Builder {
  constructor() {
    /** @type {number[]} */
    this.vertices = [];
    /** @type {number[]} */
    this.colors = [];
    /** @type {number[]} */
    this.indices = [];
    this.low = [Infinity, Infinity, Infinity];
    this.high = [-Infinity, -Infinity, -Infinity];
    this.place = placement([0, 0, 0], [0, 0, 0]);
    this.along = "z";
    this.color = [0, 0, 0];
  }

  /** @param {Matrix} place @param {string} along @param {string} color */
  begin(place, along, color) {
    this.place = place;
    this.along = along;
    this.color = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
  }

  /** Add a vertex. @param {Vector} position @param {Vector} normal @returns {number} Its index. */
  add(position, normal) {
    const [m, [x, y, z]] = [this.place, this.turn(normal)];
    const [px, py, pz] = transform(m, this.turn(position));
    this.vertices.push(px, py, pz, m[0] * x + m[4] * y + m[8] * z, m[1] * x + m[5] * y + m[9] * z, m[2] * x + m[6] * y + m[10] * z);
    this.colors.push(...this.color, 255);
    [px, py, pz].forEach((value, index) => {
      this.low[index] = Math.min(this.low[index], value);
      this.high[index] = Math.max(this.high[index], value);
    });
    return this.vertices.length / 6 - 1;
  }

  /** @param {Vector} vector Along z. @returns {Vector} Along the shape's axis. */
  turn([x, y, z]) {
    if (this.along === "x") return [z, x, y];
    return this.along === "y" ? [y, z, x] : [x, y, z];
  }

  /** Add a grid of vertices as two triangles for each field. @param {number[][]} rows Indices. */
  grid(rows) {
    for (let row = 0; row + 1 < rows.length; row += 1)
      for (let at = 0; at + 1 < rows[row].length; at += 1) {
        const [a, b, c, d] = [rows[row][at], rows[row][at + 1], rows[row + 1][at + 1], rows[row + 1][at]];
        this.indices.push(a, b, c, a, c, d);
      }
  }

  /** @returns {Mesh} */
  mesh() {
    const { low, high } = this;
    return { vertices: new Float32Array(this.vertices), colors: new Uint8Array(this.colors), indices: new Uint32Array(this.indices), low, high };
  }
}

/**
 * Add a box, whose edges may be round.
 *
 * @param {Builder} builder
 * @param {Vector} half Half of its size.
 * @param {number} round The radius of its edges.
 */
function addBox(builder, half, round) {
  const radius = Math.min(round, ...half);
  const inner = half.map((length) => length - radius);
  const lines = half.map((length, axis) => {
    if (radius === 0) return [-length, length];
    const steps = Array.from({ length: CORNER_STEPS + 1 }, (_, step) => radius * Math.tan((step / CORNER_STEPS) * (Math.PI / 4)));
    return [...steps.map((step) => -inner[axis] - step).reverse(), ...steps.map((step) => inner[axis] + step)];
  });
  for (let axis = 0; axis < 3; axis += 1)
    for (const side of [-1, 1]) {
      const [first, second] = side > 0 ? [(axis + 1) % 3, (axis + 2) % 3] : [(axis + 2) % 3, (axis + 1) % 3];
      const rows = lines[second].map((v) =>
        lines[first].map((u) => {
          const point = [0, 0, 0];
          point[axis] = side * half[axis];
          point[first] = u;
          point[second] = v;
          const normal = [0, 0, 0];
          normal[axis] = side;
          if (radius === 0) return builder.add(point, normal);
          const core = point.map((value, index) => Math.max(-inner[index], Math.min(inner[index], value)));
          const out = point.map((value, index) => value - core[index]);
          const length = Math.hypot(...out);
          const away = out.map((value) => value / length);
          return builder.add(core.map((value, index) => value + radius * away[index]), away);
        }),
      );
      builder.grid(rows);
    }
}

/**
 * Add a cylinder, or a cone.
 *
 * @param {Builder} builder
 * @param {number} bottom Radius at its bottom.
 * @param {number} top Radius at its top.
 * @param {number} half Half of its length.
 * @param {number} round The radius of its edges.
 */
function addCylinder(builder, bottom, top, half, round) {
  const radius = Math.min(round, half, bottom, top);
  const slope = Math.hypot(2 * half, bottom - top);
  const [r, z] = [(2 * half) / slope, (bottom - top) / slope];
  /** @type {Ring[]} */
  const side =
    radius > 0
      ? [...arc(bottom - radius, -half + radius, radius, -90, 0, CORNER_STEPS), ...arc(top - radius, half - radius, radius, 0, 90, CORNER_STEPS)]
      : [[bottom, -half, r, z], [top, half, r, z]];
  addLathe(builder, [[0, -half, 0, -1], [bottom - radius, -half, 0, -1]], bottom);
  addLathe(builder, side, Math.max(bottom, top));
  addLathe(builder, [[top - radius, half, 0, 1], [0, half, 0, 1]], top);
}

/**
 * Return rings on an arc around a point.
 *
 * @param {number} atR
 * @param {number} atZ
 * @param {number} radius
 * @param {number} fromDeg
 * @param {number} toDeg
 * @param {number} steps
 * @returns {Ring[]}
 */
function arc(atR, atZ, radius, fromDeg, toDeg, steps) {
  return Array.from({ length: steps + 1 }, (_, step) => {
    const angle = ((fromDeg + (step / steps) * (toDeg - fromDeg)) * Math.PI) / 180;
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return /** @type {Ring} */ ([atR + radius * c, atZ + radius * s, c, s]);
  });
}

/**
 * Add a surface of revolution.
 *
 * @param {Builder} builder
 * @param {Ring[]} rings From the bottom to the top.
 * @param {number} radius The largest radius, for the number of corners.
 */
function addLathe(builder, rings, radius) {
  const count = Math.max(16, Math.min(56, 4 * Math.round(4 + 25 * radius)));
  const rows = rings.map(([r, z, normalR, normalZ]) =>
    Array.from({ length: count + 1 }, (_, corner) => {
      const angle = (2 * Math.PI * corner) / count;
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      return builder.add([r * c, r * s, z], [normalR * c, normalR * s, normalZ]);
    }),
  );
  builder.grid(rows);
}
