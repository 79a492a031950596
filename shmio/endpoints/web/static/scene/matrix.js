// Matrices of 4 by 4 numbers, by columns as WebGL takes them. Lengths are in m, angles in rad.

/** @typedef {number[]} Vector */
/** @typedef {Float32Array} Matrix */

/** @returns {Matrix} */
export function identity() {
  return new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
}

/** @param {Matrix} a @param {Matrix} b @returns {Matrix} */
export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column += 1)
    for (let row = 0; row < 4; row += 1) {
      let sum = 0;
      for (let index = 0; index < 4; index += 1) sum += a[4 * index + row] * b[4 * column + index];
      product[4 * column + row] = sum;
    }
  return product;
}

/** @param {Vector} by @returns {Matrix} */
export function translation(by) {
  const made = identity();
  made.set(by, 12);
  return made;
}

/** @param {Vector} axis A unit vector. @param {number} angle @returns {Matrix} */
export function rotation(axis, angle) {
  const [x, y, z] = axis;
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const t = 1 - c;
  return new Float32Array([
    t * x * x + c, t * x * y + s * z, t * x * z - s * y, 0,
    t * x * y - s * z, t * y * y + c, t * y * z + s * x, 0,
    t * x * z + s * y, t * y * z - s * x, t * z * z + c, 0,
    0, 0, 0, 1,
  ]);
}

/**
 * Return where a body is relative to its parent.
 *
 * @param {Vector} positionMm
 * @param {Vector} rotationDeg Angles about the parent's x, y and z axes, applied in this order: roll, pitch and yaw.
 * @returns {Matrix}
 */
export function placement(positionMm, rotationDeg) {
  const [roll, pitch, yaw] = rotationDeg.map((angle) => (angle * Math.PI) / 180);
  const turned = multiply(rotation([0, 0, 1], yaw), multiply(rotation([0, 1, 0], pitch), rotation([1, 0, 0], roll)));
  turned.set(positionMm.map((length) => length / 1000), 12);
  return turned;
}

/** @param {number} angle The vertical field of view. @param {number} aspect @param {number} near @param {number} far @returns {Matrix} */
export function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0]);
}

/** @param {number} radius Half of the width and height. @param {number} near @param {number} far @returns {Matrix} */
export function orthographic(radius, near, far) {
  return new Float32Array([1 / radius, 0, 0, 0, 0, 1 / radius, 0, 0, 0, 0, 2 / (near - far), 0, 0, 0, (far + near) / (near - far), 1]);
}

/** @param {Vector} eye @param {Vector} target @param {Vector} up @returns {Matrix} */
export function lookAt(eye, target, up) {
  const back = unit(subtract(eye, target));
  const right = unit(cross(up, back));
  const above = cross(back, right);
  return new Float32Array([
    right[0], above[0], back[0], 0,
    right[1], above[1], back[1], 0,
    right[2], above[2], back[2], 0,
    -dot(right, eye), -dot(above, eye), -dot(back, eye), 1,
  ]);
}

/** @param {Matrix} matrix @param {Vector} point @returns {[number, number, number, number]} With the fourth coordinate. */
export function transform(matrix, point) {
  const [x, y, z] = point;
  const row = (/** @type {number} */ index) => matrix[index] * x + matrix[4 + index] * y + matrix[8 + index] * z + matrix[12 + index];
  return [row(0), row(1), row(2), row(3)];
}

/** @param {Vector} a @param {Vector} b @returns {Vector} */
export function subtract(a, b) {
  return a.map((value, index) => value - b[index]);
}

/** @param {Vector} a @param {Vector} b @param {number} factor @returns {Vector} a plus b times a factor. */
export function add(a, b, factor = 1) {
  return a.map((value, index) => value + factor * b[index]);
}

/** @param {Vector} a @param {Vector} b @returns {number} */
export function dot(a, b) {
  return a.reduce((sum, value, index) => sum + value * b[index], 0);
}

/** @param {Vector} a @param {Vector} b @returns {Vector} */
export function cross([ax, ay, az], [bx, by, bz]) {
  return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
}

/** @param {Vector} a @returns {Vector} */
export function unit(a) {
  const length = Math.hypot(...a) || 1;
  return a.map((value) => value / length);
}
