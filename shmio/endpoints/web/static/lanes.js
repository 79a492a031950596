// Plots one above the other with one time axis: lanes of registers, cursor, zoom, pictures and tables.

import { LEFT_PX, clock, draw } from "./chart.js";
import { element, notify, replace, setText } from "./dom.js";

/** @typedef {import("./series.js").Series} Series */
/** @typedef {import("./chart.js").Mark} Mark */
/** @typedef {{ path: string, type: string, unit: string, comment: string }} Signal */
/** @typedef {{ paths: string[], canvas: HTMLCanvasElement, legend: HTMLElement, root: HTMLElement }} Lane */
/**
 * @typedef {{
 *   series: (path: string) => Series[],
 *   signal: (path: string) => Signal | undefined,
 *   marks: () => Mark[],
 *   changed: (lanes: string[][]) => void,
 *   removed: (path: string) => void,
 *   moved: () => void,
 *   newest: (() => number) | null,
 *   name: () => string,
 * }} Data What the lanes show: the series of a register in the order of time, what is known about it, and events. The
 *   lanes report changes of their registers, and of the time in view. `newest` is the present time of live data, which the
 *   lanes follow unless they are paused; null for data that does not move. `name` begins the names of saved files.
 */

const REDRAW_MS = 40;
const LEAST_S = 0.001;
const MOST_S = 30 * 86_400;
const NEAR_PX = 6;
const LEAST_PINCH_PX = 30; // between two fingers

export class Lanes {
  /** @param {Data} data */
  constructor(data) {
    this.data = data;
    this.windowS = 8;
    this.paused = data.newest === null;
    this.from = 0;
    this.to = 1;
    /** @type {number | null} */
    this.cursor = null;
    /** @type {number | null} */
    this.mark = null;
    this.drawnMs = 0;
    this.asked = false;
    /** @type {Map<string, number>} */
    this.colors = new Map();
    /** @type {Lane[]} */
    this.lanes = [];
    this.times = element("span", { class: "dim" });
    this.pauseButton = element("button", { type: "button", click: () => this.pause(!this.paused) }, "Pause");
    this.root = element("div", { class: "lanes", scroll: () => this.request() });
    this.resize = new ResizeObserver(() => this.request());
    this.resize.observe(this.root);
    this.theme = new MutationObserver(() => this.request());
    this.theme.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  }

  close() {
    this.resize.disconnect();
    this.theme.disconnect();
  }

  /** All paths. */
  get paths() {
    return this.lanes.flatMap((lane) => lane.paths);
  }

  /** Width of the time axis in pixels of the screen. */
  get columns() {
    const width = Math.max(300, ...this.lanes.map((lane) => lane.canvas.clientWidth - LEFT_PX));
    return Math.min(2000, Math.round(width * devicePixelRatio));
  }

  /** @param {string} path */
  remove(path) {
    this.make(this.lanes.map((lane) => lane.paths.filter((one) => one !== path)).filter((paths) => paths.length));
    this.colors.delete(path);
    this.data.removed(path);
  }

  /**
   * Put a signal into another lane.
   *
   * @param {string} path
   * @param {number} target Index of the lane; -1 for a new one.
   */
  move(path, target) {
    const lanes = this.lanes.map((lane) => lane.paths.filter((one) => one !== path));
    if (target < 0) lanes.push([path]);
    else lanes[target].push(path);
    this.make(lanes.filter((paths) => paths.length));
  }

  /** @param {string[][]} wanted The paths of each lane. */
  make(wanted) {
    this.lanes = wanted.map((paths, index) => this.makeLane(paths, index));
    replace(this.root, ...this.lanes.map((lane) => lane.root));
    this.data.changed(wanted);
    this.request();
  }

  /** @param {string[]} paths @param {number} index @returns {Lane} */
  makeLane(paths, index) {
    const canvas = element("canvas", { tabindex: 0, role: "img", "aria-label": `Plot of ${paths.join(", ")}` });
    const legend = element("ul", { class: "legend" }, ...paths.map((path) => this.makeEntry(path, index, paths.length > 1)));
    const root = element("section", { class: "lane" }, legend, canvas);
    root.addEventListener("drop", (event) => {
      const path = event.dataTransfer?.getData("text/plain") ?? "";
      if (!this.lanes.some((lane) => lane.paths.includes(path))) return;
      event.preventDefault();
      event.stopPropagation();
      this.move(path, index);
    });
    this.listen(canvas);
    return { paths, canvas, legend, root };
  }

  /** @param {string} path @param {number} index Index of its lane. @param {boolean} joined Whether the lane has others. */
  makeEntry(path, index, joined) {
    const swatch = element("span", { class: "swatch" });
    swatch.style.background = this.color(path);
    const entry = element(
      "li",
      { draggable: "true", "data-path": path, title: "Drag this name onto another plot to join the two" },
      swatch,
      element("span", { class: "name" }, path),
      element("output", { class: "value" }),
      index > 0 ? element("button", { type: "button", "aria-label": `Join ${path} with the plot above`, title: "Join with the plot above", click: () => this.move(path, index - 1) }, "↑") : null,
      joined ? element("button", { type: "button", "aria-label": `Plot ${path} alone`, title: "Give it a plot of its own", click: () => this.move(path, -1) }, "↓") : null,
      element("button", { type: "button", "aria-label": `Remove ${path}`, click: () => this.remove(path) }, "×"),
    );
    entry.addEventListener("dragstart", (event) => event.dataTransfer?.setData("text/plain", path));
    return entry;
  }

  /** @param {string} path @returns {string} Its color, which it keeps. */
  color(path) {
    let number = this.colors.get(path);
    if (number === undefined) {
      const taken = new Set(this.colors.values());
      for (number = 0; taken.has(number); number += 1);
      this.colors.set(path, number);
    }
    return `hsl(${Math.round(210 + 137.5 * number) % 360} 70% 50%)`;
  }

  /**
   * Let the user move the plots: drag or swipe to move, wheel or two fingers to zoom, click or tap to set the mark.
   *
   * @param {HTMLCanvasElement} canvas
   */
  listen(canvas) {
    const timeAt = (/** @type {number} */ x) => {
      const box = canvas.getBoundingClientRect();
      return this.from + ((x - box.left - LEFT_PX) / (box.width - LEFT_PX)) * (this.to - this.from);
    };
    /** @type {Map<number, number>} The horizontal position of each pressed pointer. */
    const pressed = new Map();
    /** @type {{ time: number, moved: boolean } | null} */
    let drag = null;
    /** @type {number | null} Where a finger tapped last: a finger cannot point without pressing. */
    let tapped = null;
    canvas.addEventListener("pointerdown", (event) => {
      pressed.set(event.pointerId, event.clientX);
      drag = { time: timeAt(event.clientX), moved: pressed.size > 1 };
      this.cursor = drag.time;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const time = timeAt(event.clientX);
      const before = pressed.get(event.pointerId);
      const other = [...pressed].find(([id]) => id !== event.pointerId)?.[1];
      if (before !== undefined) pressed.set(event.pointerId, event.clientX);
      if (before !== undefined && other !== undefined) {
        const [old, fresh] = [before, event.clientX].map((x) => Math.max(LEAST_PINCH_PX, Math.abs(x - other)));
        if (old !== fresh) this.zoom(old / fresh, timeAt(other));
        return;
      }
      if (drag !== null && (drag.moved || Math.abs(time - drag.time) > 0.005 * (this.to - this.from))) {
        drag.moved = true;
        this.pause(true);
        this.shift(drag.time - time);
      }
      this.cursor = timeAt(event.clientX);
      this.request();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (drag !== null && !drag.moved) {
        const place = event.pointerType === "touch" ? tapped : this.cursor;
        this.mark = this.mark === null ? place : null;
        tapped = this.cursor;
      }
    });
    canvas.addEventListener("lostpointercapture", (event) => {
      pressed.delete(event.pointerId);
      const [rest] = pressed.values();
      drag = rest === undefined ? null : { time: timeAt(rest), moved: true };
      this.request();
    });
    canvas.addEventListener("pointerleave", (event) => {
      if (drag !== null || event.pointerType === "touch") return;
      this.cursor = null;
      this.request();
    });
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(event.deltaY > 0 ? 1.25 : 0.8, timeAt(event.clientX));
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", (event) => {
      const span = this.to - this.from;
      const middle = this.from + span / 2;
      const act = {
        ArrowLeft: () => (this.pause(true), this.shift(-0.1 * span)),
        ArrowRight: () => (this.pause(true), this.shift(0.1 * span)),
        "+": () => this.zoom(0.8, middle),
        "-": () => this.zoom(1.25, middle),
        " ": () => this.pause(!this.paused),
      }[event.key];
      if (act === undefined) return;
      event.preventDefault();
      act();
    });
  }

  /** @param {number} seconds */
  shift(seconds) {
    this.from += seconds;
    this.to += seconds;
    this.moved();
  }

  /** @param {number} factor @param {number} around */
  zoom(factor, around) {
    const span = Math.min(MOST_S, Math.max(LEAST_S, factor * (this.to - this.from)));
    if (this.paused) {
      const share = (around - this.from) / (this.to - this.from);
      this.from = around - share * span;
      this.to = this.from + span;
    } else this.windowS = span;
    this.moved();
  }

  /** Show a time span. @param {number} seconds */
  show(seconds) {
    this.windowS = seconds;
    if (this.paused) this.from = this.to - seconds;
    this.moved();
  }

  /** Show the time between two moments. @param {number} from @param {number} to */
  showRange(from, to) {
    this.from = from;
    this.to = Math.max(to, from + LEAST_S);
    this.moved();
  }

  moved() {
    this.request();
    this.data.moved();
  }

  /** @param {boolean} paused */
  pause(paused) {
    this.paused = paused || this.data.newest === null;
    setText(this.pauseButton, paused ? "Live" : "Pause");
    this.request();
  }

  /** Draw soon. */
  request() {
    if (this.asked) return;
    this.asked = true;
    setTimeout(() => requestAnimationFrame(() => this.draw()), Math.max(0, REDRAW_MS - (performance.now() - this.drawnMs)));
  }

  /** @param {boolean} [all] Draw the lanes that are scrolled out of view as well. */
  draw(all = false) {
    this.asked = false;
    this.drawnMs = performance.now();
    if (!this.paused && this.data.newest !== null) {
      this.to = this.data.newest();
      this.from = this.to - this.windowS;
    }
    const marks = this.data.marks();
    const view = { from: this.from, to: this.to, cursor: this.cursor, mark: this.mark, marks };
    let pixelS = 0;
    const scale = devicePixelRatio;
    const seen = this.root.getBoundingClientRect();
    const sizes = this.lanes.map(({ paths, canvas, legend, root }) => {
      const { top, bottom } = root.getBoundingClientRect();
      const { clientWidth: width, clientHeight: height } = canvas;
      return { paths, canvas, legend, width, height, visible: bottom > seen.top && top < seen.bottom };
    }); // all of them before the first change, so that the browser computes the layout once
    for (const { paths, canvas, legend, width, height, visible } of sizes) {
      if (!visible && !all) continue;
      if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
      if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
      const pen = canvas.getContext("2d");
      if (pen === null || width === 0) continue;
      pixelS = (this.to - this.from) / (width - LEFT_PX);
      pen.setTransform(scale, 0, 0, scale, 0, 0);
      draw(pen, width, height, this.lines(paths), view);
      paths.forEach((path, index) => this.fill(path, legend.children[index]));
    }
    const { cursor } = this;
    const difference = this.mark !== null && cursor !== null ? `, Δt ${(cursor - this.mark).toFixed(3)} s` : "";
    const near = cursor === null ? undefined : nearest(marks, cursor, NEAR_PX * pixelS);
    setText(this.times, cursor === null ? "" : `${clock(cursor)}${difference}${near === undefined ? "" : `: ${near.text}`}`);
  }

  /** @param {string[]} paths */
  lines(paths) {
    return paths.flatMap((path) =>
      this.data.series(path).map((series) => ({ series, color: this.color(path), steps: this.data.signal(path)?.type === "BOOL" })),
    );
  }

  /** Show the value of a signal: at the cursor, else the newest one. @param {string} path @param {Element} entry */
  fill(path, entry) {
    const signal = this.data.signal(path);
    const unit = signal?.unit ? ` ${signal.unit}` : durations.has(signal?.type ?? "") ? " ms" : "";
    const value = this.valueAt(path, this.cursor ?? this.to);
    const text = Number.isNaN(value) ? "no value" : `${format(value)}${unit}`;
    const change = this.mark !== null && this.cursor !== null ? value - this.valueAt(path, this.mark) : NaN;
    setText(entry.children[2], Number.isNaN(change) ? text : `${text} (Δ ${format(change)})`);
  }

  /** @param {string} path @param {number} time @returns {number} NaN if there is no value. */
  valueAt(path, time) {
    const begun = this.data.series(path).filter((series) => series.count && series.times[0] <= time);
    return begun.length ? begun[begun.length - 1].valueAt(time) : NaN;
  }

  /** Save the plots as a picture. */
  savePicture() {
    const parts = this.lanes.map((lane) => lane.canvas);
    if (!parts.length) return;
    this.draw(true);
    const scale = devicePixelRatio;
    const head = 22 * scale;
    const whole = document.createElement("canvas");
    whole.width = Math.max(...parts.map((part) => part.width));
    whole.height = parts.reduce((sum, part) => sum + part.height + head, 0);
    const pen = whole.getContext("2d");
    if (pen === null) return;
    const style = getComputedStyle(document.documentElement);
    pen.fillStyle = style.getPropertyValue("--back");
    pen.fillRect(0, 0, whole.width, whole.height);
    pen.font = `${12 * scale}px system-ui, sans-serif`;
    let top = 0;
    for (const lane of this.lanes) {
      let left = 8 * scale;
      for (const path of lane.paths) {
        pen.fillStyle = this.color(path);
        const text = `${path} ${this.data.signal(path)?.unit ?? ""}`.trim();
        pen.fillText(text, left, top + 15 * scale);
        left += pen.measureText(text).width + 16 * scale;
      }
      pen.drawImage(lane.canvas, 0, top + head);
      top += head + lane.canvas.height;
    }
    whole.toBlob((blob) => blob && this.save(blob, "png"));
  }

  /** Save the samples in view as a table: a row for each time, a column for each register. */
  saveTable() {
    const { paths } = this;
    const all = paths.flatMap((path, column) => this.data.series(path).map((series) => ({ series, column, next: series.at(this.from) })));
    const rows = [["time", ...paths].map(quoted).join(",")];
    for (;;) {
      const times = all.map(({ series, next }) => (next < series.count ? series.times[next] : Infinity));
      const time = Math.min(...times);
      if (time > this.to || time === Infinity) break;
      const cells = paths.map(() => "");
      all.forEach((one, index) => {
        if (times[index] !== time) return;
        const value = one.series.values[one.next];
        if (!Number.isNaN(value)) cells[one.column] = String(value);
        one.next += 1;
      });
      rows.push([new Date(1000 * time).toISOString(), ...cells].join(","));
    }
    if (all.some(({ series }) => series.reduced)) {
      notify("The table has the values that the plot draws, not every frame of the recording. Zoom in, or use shmio-dump export.");
    }
    this.save(new Blob([`${rows.join("\r\n")}\r\n`], { type: "text/csv" }), "csv");
  }

  /** @param {Blob} blob @param {string} kind */
  save(blob, kind) {
    const address = URL.createObjectURL(blob);
    const stamp = new Date(1000 * this.to).toISOString().replaceAll(":", "-").slice(0, 19);
    element("a", { href: address, download: `${this.data.name()}-${stamp}.${kind}` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10_000);
  }
}

const durations = new Set(["TIME", "S5TIME", "TIME_OF_DAY", "LTIME", "LTOD"]);

/**
 * Return the mark that is nearest to a time.
 *
 * @param {Mark[]} marks
 * @param {number} time
 * @param {number} most Largest distance in s.
 * @returns {Mark | undefined}
 */
function nearest(marks, time, most) {
  let found;
  let least = most;
  for (const mark of marks) {
    const distance = Math.abs(mark.time - time);
    if (distance <= least) [found, least] = [mark, distance];
  }
  return found;
}

/** @param {number} value @returns {string} */
function format(value) {
  return Number.isInteger(value) ? String(value) : Number(value.toPrecision(7)).toString();
}

/** @param {string} text @returns {string} A cell of a CSV file. A text that a spreadsheet would compute is made harmless. */
function quoted(text) {
  const safe = /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}
