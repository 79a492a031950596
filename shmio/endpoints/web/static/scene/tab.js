// The 3D tab: the cell as the registers move it, and a list of these registers.

import { element, notify, replace, setText } from "../dom.js";
import { Feeds } from "../feeds.js";
import { Camera, FIELD_OF_VIEW } from "./camera.js";
import { Kinematics } from "./kinematics.js";
import { multiply, transform } from "./matrix.js";
import { Renderer } from "./renderer.js";

/** @typedef {import("../main.js").Context} Context */
/** @typedef {import("../series.js").Series} Series */
/** @typedef {import("./kinematics.js").Body} Body */
/** @typedef {import("./kinematics.js").State} State */
/** @typedef {{ target_mm: number[] | null, distance_mm: number | null, azimuth_deg: number, elevation_deg: number }} FirstView */
/** @typedef {{ bodies: Body[], floor: import("./renderer.js").Floor | null, camera: FirstView | null }} Scene */
/** @typedef {import("../registers.js").Value} Value */
/** @typedef {{ root: HTMLElement, body: number, text: string, registers: string[] }} Label `registers` move the body and what it carries. */

const REDRAW_MS = 40;
const MAX_REASONS = 5;
const MAX_SAMPLES = 400_000;
// The picture is so much older than the newest sample that it can move evenly between two samples.
const LEAST_DELAY_S = 0.08;
const MOST_DELAY_S = 1;
const FIRST_VIEW = { target_mm: null, distance_mm: null, azimuth_deg: -60, elevation_deg: 25 };
const COLORS = /** @type {const} */ (["back", "sky", "floor", "line", "injected", "accent"]);

export class SceneTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    /** @type {Scene | null} */
    this.scene = null;
    /** @type {Kinematics | null} */
    this.kinematics = null;
    /** @type {Renderer | null} */
    this.renderer = null;
    /** @type {Record<string, Value>} */
    this.values = {};
    /** @type {string[]} */
    this.registers = [];
    /** @type {Set<number>} */
    this.highlighted = new Set();
    this.asked = false;
    this.changed = true;
    this.drawnMs = 0;
    this.closed = false;

    this.canvas = element("canvas", {
      tabindex: 0,
      role: "img",
      "aria-label": "The cell in 3D. Arrow keys turn it, with Shift they move it; plus and minus zoom; Home shows all.",
    });
    /** @type {Label[]} */
    this.labels = [];
    this.over = element("div", { class: "scene-labels" });
    this.problem = element("p", { class: "scene-problem", hidden: true });
    this.list = element("table", { class: "scene-registers", "aria-label": "Registers that move the bodies" });
    this.reasons = element("ul", { class: "scene-reasons", role: "status" });
    const look = (/** @type {string} */ text, /** @type {number} */ azimuth, /** @type {number} */ elevation) =>
      element("button", { type: "button", click: () => this.camera.set({ azimuth: radians(azimuth), elevation: radians(elevation) }) }, text);
    this.root = element(
      "div",
      { class: "scene" },
      element(
        "div",
        { class: "bar" },
        element("button", { type: "button", click: () => this.camera.reset() }, "Show all"),
        look("Top", -90, 89),
        look("Front", -90, 8),
        look("Right", 0, 8),
        element("span", { class: "dim" }, "Drag to turn, Shift and drag to move, wheel to zoom; two fingers move and zoom"),
      ),
      element("div", { class: "scene-body" }, element("div", { class: "scene-picture" }, this.canvas, this.over, this.problem), element("div", { class: "scene-list" }, this.reasons, this.list)),
    );
    this.feeds = new Feeds(context.connection, () => this.registers, () => this.request(), MAX_SAMPLES);
    this.stop = context.connection.follow("registers", (values) => this.show(values));
    this.resize = new ResizeObserver(() => this.redraw());
    this.resize.observe(this.canvas);
    this.theme = new MutationObserver(() => this.redraw());
    this.theme.observe(document.documentElement, { attributeFilter: ["data-theme"] });
    this.system = matchMedia("(prefers-color-scheme: dark)");
    this.system.onchange = () => this.redraw();
    this.camera = new Camera(() => this.redraw());
    this.camera.listen(this.canvas);
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.renderer = null;
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.prepare());
  }

  close() {
    this.closed = true;
    this.feeds.close();
    this.stop();
    this.resize.disconnect();
    this.theme.disconnect();
    this.system.onchange = null;
    this.renderer?.close();
    this.context.connection.call("registers.follow", { paths: [] }).catch(() => {});
  }

  /** Request the scene and the values again: the connection is new. */
  async resume() {
    try {
      const scene = await this.context.connection.call("scene.get");
      if (this.closed) return;
      if (JSON.stringify(scene) !== JSON.stringify(this.scene)) this.open(scene);
      this.feeds.resume();
      await this.context.connection.call("registers.follow", { paths: this.registers });
    } catch (error) {
      if (this.context.connection.open && !this.closed) notify(String(/** @type {Error} */ (error).message), "problem");
    }
  }

  /** Show a scene. @param {Scene} scene */
  open(scene) {
    this.scene = scene;
    this.kinematics = new Kinematics(scene.bodies);
    const joints = scene.bodies.flatMap((body) => (body.joint === null ? [] : [body.joint.register]));
    this.registers = [...new Set(joints)];
    this.lines = this.registers.map((path) => this.makeLine(path));
    const heads = ["Register", "Value", "State"].map((text, index) => element("th", { scope: "col", class: index === 1 ? "number" : null }, text));
    replace(this.list, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...this.lines));
    this.labels = scene.bodies.flatMap((body, index) => (body.label ? [makeLabel(scene.bodies, index)] : []));
    replace(this.over, ...this.labels.map((label) => label.root));
    this.prepare();
  }

  /** Prepare the graphics processor. */
  prepare() {
    if (this.scene === null || this.kinematics === null) return;
    const gl = this.canvas.getContext("webgl2", { antialias: true, alpha: false });
    this.problem.hidden = gl !== null;
    if (gl === null) {
      setText(this.problem, "This browser has no WebGL 2, so it cannot draw the cell. The list has the values that move it.");
      return;
    }
    this.renderer = new Renderer(gl, this.scene.bodies, this.scene.floor);
    const { center, radius } = this.renderer.measure(this.kinematics.world);
    const first = this.scene.camera ?? FIRST_VIEW;
    this.camera.frame(radius, {
      target: first.target_mm?.map((length) => length / 1000) ?? center,
      distance: first.distance_mm === null ? (0.85 * radius) / Math.sin(FIELD_OF_VIEW / 2) : first.distance_mm / 1000,
      azimuth: radians(first.azimuth_deg),
      elevation: radians(first.elevation_deg),
    });
    this.redraw();
  }

  /** @param {string} path @returns {HTMLTableRowElement} */
  makeLine(path) {
    const line = element(
      "tr",
      { "data-path": path, title: "Point here to see what this register moves" },
      element("td", {}, path),
      element("td", { class: "number" }),
      element("td"),
    );
    const choose = (/** @type {boolean} */ chosen) => () => {
      this.highlighted = new Set(chosen ? this.moved(path) : []);
      this.redraw();
    };
    line.addEventListener("pointerenter", choose(true));
    line.addEventListener("pointerleave", choose(false));
    return line;
  }

  /** @param {string} path @returns {number[]} The bodies that a register moves, with those that they carry. */
  moved(path) {
    const bodies = this.scene?.bodies ?? [];
    return bodies.flatMap((body, index) => (body.joint?.register === path ? [...carried(bodies, index)] : []));
  }

  /** @param {Record<string, Value>} values */
  show(values) {
    this.values = values;
    /** @type {Map<string, number>} */
    const reasons = new Map();
    this.registers.forEach((path, index) => {
      const value = values[path];
      const cells = this.lines?.[index].cells;
      if (value === undefined || cells === undefined) return;
      const [text, quality, reason, origin] = value;
      const unit = this.feeds.signals.get(path)?.unit;
      setText(cells[1], text === null ? "no value" : `${short(text)}${unit ? ` ${unit}` : ""}`);
      setText(cells[2], quality === "good" ? origin : quality);
      cells[2].className = quality === "good" ? origin : quality;
      cells[2].title = reason;
      const state = this.judge(path);
      if (state === "good") return;
      const words = state === "bad" ? `bad, and hatched: ${reason || "no reason is known"}` : "injected, and coloured";
      reasons.set(words, (reasons.get(words) ?? 0) + 1);
    });
    const lines = [...reasons].map(([words, count]) => `${count} ${count === 1 ? "is" : "are"} ${words}`);
    if (lines.length > MAX_REASONS) lines.splice(MAX_REASONS, Infinity, `and ${lines.length - MAX_REASONS} other reasons`);
    while (this.reasons.children.length > lines.length) this.reasons.lastChild?.remove();
    while (this.reasons.children.length < lines.length) this.reasons.append(element("li"));
    lines.forEach((line, index) => {
      const item = this.reasons.children[index];
      setText(item, line);
      item.className = line.endsWith("coloured") ? "injected" : "bad";
    });
    for (const label of this.labels) this.fillLabel(label);
    if (this.kinematics?.judge((path) => this.judge(path))) this.redraw();
  }

  /** Say at a label whether what belongs to it can be trusted. @param {Label} label */
  fillLabel({ root, text, registers }) {
    const bad = registers.some((path) => this.judge(path) === "bad");
    const injected = registers.some((path) => this.judge(path) === "injected");
    setText(root, bad ? `${text}: bad` : injected ? `${text}: injected` : text);
    root.className = `scene-label ${bad ? "bad" : injected ? "injected" : ""}`;
  }

  /** @param {string} path @returns {State} */
  judge(path) {
    const value = this.values[path];
    if (value === undefined) return "good"; // not known yet
    if (value[1] === "bad") return "bad";
    return value[3] === "injected" ? "injected" : "good";
  }

  /** Draw soon, although nothing may have moved. */
  redraw() {
    this.changed = true;
    this.request();
  }

  /** Draw soon, if something has moved. */
  request() {
    if (this.asked || this.closed) return;
    this.asked = true;
    setTimeout(() => requestAnimationFrame(() => this.draw()), Math.max(0, REDRAW_MS - (performance.now() - this.drawnMs)));
  }

  draw() {
    this.asked = false;
    const { kinematics, renderer, camera, canvas } = this;
    if (kinematics === null || renderer === null || this.closed) return;
    const now = performance.now();
    const moved = kinematics.move((path) => this.value(path), Math.min(1, (now - this.drawnMs) / 1000));
    this.drawnMs = now;
    if (!moved && !this.changed) return;
    this.changed = false;
    const { clientWidth, clientHeight } = canvas;
    const scale = Math.min(2, devicePixelRatio);
    const [width, height] = [clientWidth, clientHeight].map((length) => Math.max(1, Math.round(length * scale)));
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const { view, projection } = camera.matrices(width / height);
    const style = getComputedStyle(canvas);
    const colors = Object.fromEntries(COLORS.map((name) => [name, parsed(style.getPropertyValue(`--${name}`))]));
    renderer.draw({
      world: kinematics.world,
      states: kinematics.states,
      highlighted: this.highlighted,
      eye: camera.eye,
      view,
      projection,
      colors: /** @type {import("./renderer.js").Colors} */ (colors),
      dark: colors.back[1] < 0.5,
    });
    this.placeLabels(multiply(projection, view), clientWidth, clientHeight);
    if (moved) this.request(); // a joint may still follow its register
  }

  /** @param {import("./matrix.js").Matrix} toScreen @param {number} width @param {number} height */
  placeLabels(toScreen, width, height) {
    for (const { root, body } of this.labels) {
      const world = this.kinematics?.world[body];
      if (world === undefined) return;
      const [x, y, , w] = transform(toScreen, [...world.slice(12, 15)]);
      root.hidden = w <= 0;
      root.style.transform = `translate(${((x / w + 1) * width) / 2}px, ${((1 - y / w) * height) / 2}px) translate(-50%, 8px)`;
    }
  }

  /** @param {string} path @returns {number} The value of a register at the time of the picture; NaN if there is none. */
  value(path) {
    const series = this.feeds.series.get(path);
    if (series === undefined || series.count === 0) return NaN;
    const period = this.feeds.bySource.get(path.split("/")[0])?.period_ms ?? 0;
    const delay = Math.min(MOST_DELAY_S, Math.max(LEAST_DELAY_S, 0.0012 * period + 0.05));
    return between(series, Date.now() / 1000 - this.feeds.lagS - delay);
  }
}

/** @param {Body[]} bodies @param {number} index @returns {Set<number>} A body, and all that it carries. */
function carried(bodies, index) {
  const found = new Set([index]);
  bodies.forEach((body, at) => found.has(body.parent) && found.add(at));
  return found;
}

/** @param {Body[]} bodies @param {number} index @returns {Label} */
function makeLabel(bodies, index) {
  const registers = [...carried(bodies, index)].flatMap((at) => bodies[at].joint?.register ?? []);
  return { root: element("span", { class: "scene-label" }), body: index, text: bodies[index].label, registers };
}

/** @param {Series} series @param {number} time @returns {number} The value at a time, between the samples before and after it. */
function between(series, time) {
  const index = series.at(time);
  const after = index < series.count ? series.values[index] : NaN;
  const before = index > 0 ? series.values[index - 1] : NaN;
  if (!Number.isFinite(before)) return after;
  if (!Number.isFinite(after)) return before;
  const span = series.times[index] - series.times[index - 1];
  return span > 0 ? before + ((after - before) * (time - series.times[index - 1])) / span : after;
}

/** @param {string} text @returns {string} A number with at most three decimals. */
function short(text) {
  return /^-?\d+\.\d{4,}$/.test(text) ? Number(text).toFixed(3) : text;
}

/** @param {string} text A colour as the browser resolves it: rgb(…). @returns {number[]} From 0 to 1. */
function parsed(text) {
  return (text.match(/[\d.]+/g) ?? ["0", "0", "0"]).slice(0, 3).map((part) => Number(part) / 255);
}

/** @param {number} degrees @returns {number} */
function radians(degrees) {
  return (degrees * Math.PI) / 180;
}
