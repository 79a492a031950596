// Draws bodies with WebGL 2: one pass for the shadows, and one for the picture.

import { lookAt, multiply, orthographic, unit, add } from "./matrix.js";
import { makeMesh } from "./mesh.js";
import * as shaders from "./shaders.js";

/** @typedef {import("./matrix.js").Vector} Vector */
/** @typedef {import("./matrix.js").Matrix} Matrix */
/** @typedef {import("./kinematics.js").State} State */
/** @typedef {{ size_mm: Vector, center_mm: Vector, grid_mm: number }} Floor */
/** @typedef {{ vertices: WebGLVertexArrayObject, count: number, low: Vector, high: Vector }} Drawable */
/** @typedef {{ program: WebGLProgram, places: Map<string, WebGLUniformLocation> }} Program */
/** @typedef {Record<"back" | "sky" | "floor" | "line" | "injected" | "accent", Vector>} Colors From 0 to 1. */
/**
 * @typedef {{ world: Matrix[], states: State[], highlighted: Set<number>, eye: Vector, view: Matrix, projection: Matrix, colors: Colors,
 *   dark: boolean }} Picture
 */

const SHADOW_SIZE = 2048;
const SUN = unit([-0.72, -0.38, 1]);
const STATES = { good: 0, injected: 1, bad: 2 };

export class Renderer {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {import("./kinematics.js").Body[]} bodies
   * @param {Floor | null} floor
   */
  constructor(gl, bodies, floor) {
    this.gl = gl;
    this.floor = floor;
    this.body = makeProgram(gl, shaders.BODY_VERTEX, shaders.BODY_FRAGMENT);
    this.ground = makeProgram(gl, shaders.FLOOR_VERTEX, shaders.FLOOR_FRAGMENT);
    this.shadow = makeProgram(gl, shaders.SHADOW_VERTEX, shaders.SHADOW_FRAGMENT);
    this.sky = makeProgram(gl, shaders.SKY_VERTEX, shaders.SKY_FRAGMENT);
    /** @type {(Drawable | null)[]} Null for a body without shapes. */
    this.drawables = bodies.map((body) => (body.shapes.length ? upload(gl, makeMesh(body.shapes)) : null));
    this.empty = gl.createVertexArray();
    this.shadowMap = gl.createTexture();
    this.shadowFrame = gl.createFramebuffer();
    gl.bindTexture(gl.TEXTURE_2D, this.shadowMap);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SHADOW_SIZE, SHADOW_SIZE);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.LINEAR);
    for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowFrame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.shadowMap, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.center = [0, 0, 0];
    this.radius = 1;
  }

  /**
   * Measure the scene.
   *
   * @param {Matrix[]} world
   * @returns {{ center: Vector, radius: number }} A sphere around all bodies, in m.
   */
  measure(world) {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    this.drawables.forEach((drawable, index) => {
      if (drawable === null) return;
      for (let corner = 0; corner < 8; corner += 1) {
        const [x, y, z] = [0, 1, 2].map((axis) => (corner & (1 << axis) ? drawable.high : drawable.low)[axis]);
        const m = world[index];
        [0, 1, 2].forEach((row) => {
          const value = m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row];
          low[row] = Math.min(low[row], value);
          high[row] = Math.max(high[row], value);
        });
      }
    });
    if (low[0] > high[0]) return { center: [0, 0, 0], radius: 1 };
    this.center = low.map((value, axis) => (value + high[axis]) / 2);
    this.radius = Math.max(0.05, Math.hypot(...low.map((value, axis) => high[axis] - value)) / 2);
    return { center: this.center, radius: this.radius };
  }

  /** Draw. @param {Picture} picture */
  draw(picture) {
    const { gl } = this;
    const { width, height } = gl.canvas;
    const reach = 1.25 * this.radius;
    const light = multiply(
      orthographic(reach, 0, 4 * reach),
      lookAt(add(this.center, SUN, 2 * reach), this.center, [0, 0, 1]),
    );
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowFrame);
    gl.viewport(0, 0, SHADOW_SIZE, SHADOW_SIZE);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1.5, 3);
    gl.useProgram(this.shadow.program);
    gl.uniformMatrix4fv(place(this.shadow, "toScreen"), false, light);
    this.drawBodies(this.shadow, picture.world);
    gl.disable(gl.POLYGON_OFFSET_FILL);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.depthMask(false);
    gl.useProgram(this.sky.program);
    gl.uniform3fv(place(this.sky, "low"), picture.colors.back);
    gl.uniform3fv(place(this.sky, "high"), picture.colors.sky);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.depthMask(true);

    const toScreen = multiply(picture.projection, picture.view);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.shadowMap);
    this.light(this.body, picture, light, toScreen);
    gl.uniform3fv(place(this.body, "injected"), linear(picture.colors.injected));
    gl.uniform3fv(place(this.body, "accent"), linear(picture.colors.accent));
    gl.uniform1f(place(this.body, "pixel"), devicePixelRatio);
    this.drawBodies(this.body, picture.world, (index) => {
      gl.uniform1i(place(this.body, "state"), STATES[picture.states[index]]);
      gl.uniform1f(place(this.body, "highlight"), picture.highlighted.has(index) ? 1 : 0);
    });
    if (this.floor !== null) this.drawFloor(this.floor, picture, light, toScreen);
    gl.bindTexture(gl.TEXTURE_2D, null);
    gl.bindVertexArray(null);
  }

  /** @param {Floor} floor @param {Picture} picture @param {Matrix} light @param {Matrix} toScreen */
  drawFloor(floor, picture, light, toScreen) {
    const { gl } = this;
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE);
    this.light(this.ground, picture, light, toScreen);
    gl.uniform4f(place(this.ground, "extent"), floor.center_mm[0] / 1000, floor.center_mm[1] / 1000, floor.size_mm[0] / 2000, floor.size_mm[1] / 2000);
    gl.uniform1f(place(this.ground, "grid"), floor.grid_mm / 1000);
    gl.uniform3fv(place(this.ground, "floorColor"), picture.colors.floor);
    gl.uniform3fv(place(this.ground, "lineColor"), picture.colors.line);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.BLEND);
  }

  /** Choose a program, and give it what lights the scene. @param {Program} program @param {Picture} picture @param {Matrix} light @param {Matrix} toScreen */
  light(program, picture, light, toScreen) {
    const { gl } = this;
    gl.useProgram(program.program);
    gl.uniformMatrix4fv(place(program, "toScreen"), false, toScreen);
    gl.uniformMatrix4fv(place(program, "toShadow"), false, light);
    gl.uniform3fv(place(program, "eye"), picture.eye);
    gl.uniform3fv(place(program, "sun"), SUN);
    gl.uniform1i(place(program, "shadowMap"), 0);
    gl.uniform1f(place(program, "shadowTexel"), 1 / SHADOW_SIZE);
    gl.uniform3fv(place(program, "skyLight"), picture.dark ? [0.4, 0.44, 0.5] : [0.62, 0.66, 0.72]);
    gl.uniform3fv(place(program, "groundLight"), picture.dark ? [0.14, 0.14, 0.15] : [0.3, 0.29, 0.28]);
    gl.uniform1f(place(program, "sunLight"), picture.dark ? 0.85 : 1.0);
  }

  /** @param {Program} program @param {Matrix[]} world @param {(index: number) => void} [prepare] */
  drawBodies(program, world, prepare) {
    const { gl } = this;
    this.drawables.forEach((drawable, index) => {
      if (drawable === null) return;
      prepare?.(index);
      gl.uniformMatrix4fv(place(program, "model"), false, world[index]);
      gl.bindVertexArray(drawable.vertices);
      gl.drawElements(gl.TRIANGLES, drawable.count, gl.UNSIGNED_INT, 0);
    });
  }

  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

/** @param {Vector} color @returns {Vector} Its light, which is not proportional to its number. */
function linear(color) {
  return color.map((part) => part ** 2.2);
}

/** @param {Program} program @param {string} name @returns {WebGLUniformLocation | null} */
function place(program, name) {
  return program.places.get(name) ?? null;
}

/** @param {WebGL2RenderingContext} gl @param {string} vertex @param {string} fragment @returns {Program} */
function makeProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]])) {
    const shader = gl.createShader(kind);
    if (shader === null) throw new Error("the graphics processor is lost");
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program)?.map((shader) => gl.getShaderInfoLog(shader)) ?? [];
    throw new Error(`a shader is wrong: ${[gl.getProgramInfoLog(program), ...logs].join(" ")}`);
  }
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
  /** @type {Map<string, WebGLUniformLocation>} */
  const places = new Map();
  for (let index = 0; index < count; index += 1) {
    const name = gl.getActiveUniform(program, index)?.name ?? "";
    const found = gl.getUniformLocation(program, name);
    if (found !== null) places.set(name, found);
  }
  return { program, places };
}

/** @param {WebGL2RenderingContext} gl @param {import("./mesh.js").Mesh} mesh @returns {Drawable} */
function upload(gl, mesh) {
  const vertices = gl.createVertexArray();
  gl.bindVertexArray(vertices);
  const buffer = (/** @type {number} */ kind, /** @type {AllowSharedBufferSource} */ data) => {
    gl.bindBuffer(kind, gl.createBuffer());
    gl.bufferData(kind, data, gl.STATIC_DRAW);
  };
  buffer(gl.ARRAY_BUFFER, mesh.vertices);
  for (const location of [0, 1]) {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 24, 12 * location);
  }
  buffer(gl.ARRAY_BUFFER, mesh.colors);
  gl.enableVertexAttribArray(2);
  gl.vertexAttribPointer(2, 4, gl.UNSIGNED_BYTE, true, 0, 0);
  buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.indices);
  gl.bindVertexArray(null);
  return { vertices, count: mesh.indices.length, low: mesh.low, high: mesh.high };
}
