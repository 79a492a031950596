// The plots tab: registers over time, in lanes with one time axis.

import { LEFT_PX, clock, draw } from "./chart.js";
import { element, notify, replace, setText } from "./dom.js";
import { Series } from "./series.js";

/** @typedef {import("./main.js").Context} Context */
/** @typedef {{ path: string, type: string, unit: string, comment: string }} Signal */
/** @typedef {{ number: number, signals: Signal[] }} Feed */
/** @typedef {{ paths: string[], canvas: HTMLCanvasElement, legend: HTMLElement, root: HTMLElement }} Lane */

const MAX_SIGNALS = 200;
const MAX_SAMPLES = 4_000_000;
const REDRAW_MS = 40;
const RETRY_MS = 3000;
const WINDOWS_S = [2, 8, 30, 120, 600];
const HEAD_BYTES = 16;
const KEY = "plots";

/** @returns {string[][]} The paths that are plotted, by lane. */
function stored() {
  try {
    return JSON.parse(sessionStorage.getItem(KEY) ?? "[]");
  } catch {
    return [];
  }
}

/**
 * Add a register to the plots, in a lane of its own.
 *
 * @param {string} path Its path, with the source.
 */
export function plot(path) {
  const lanes = stored();
  if (lanes.flat().length >= MAX_SIGNALS) notify(`A page plots at most ${MAX_SIGNALS} registers. Remove some first.`, "problem");
  else if (!lanes.flat().includes(path)) {
    sessionStorage.setItem(KEY, JSON.stringify([...lanes, [path]]));
    notify(`${path} is plotted`);
  }
}

export class PlotsTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    /** @type {Map<string, Series>} */
    this.series = new Map();
    /** @type {Map<string, Signal>} */
    this.signals = new Map();
    /** @type {Map<string, Feed>} */
    this.feeds = new Map();
    /** @type {Map<number, Feed>} */
    this.byNumber = new Map();
    this.windowS = 8;
    this.paused = false;
    this.from = 0;
    this.to = 1;
    /** @type {number | null} */
    this.cursor = null;
    /** @type {number | null} */
    this.mark = null;
    this.lagS = Infinity; // of this computer's clock against the server's times
    this.drawnMs = 0;
    this.asked = false;
    /** @type {Map<string, number>} */
    this.colors = new Map();
    /** @type {Lane[]} */
    this.lanes = [];

    this.search = element("input", { type: "search", placeholder: "Add a register", "aria-label": "Add a register", list: "plot-paths", maxlength: 200 });
    this.found = element("datalist", { id: "plot-paths" });
    this.search.addEventListener("input", () => this.suggest());
    this.pauseButton = element("button", { type: "button", click: () => this.pause(!this.paused) }, "Pause");
    this.windowSelect = element(
      "select",
      { "aria-label": "Time span", change: () => this.show(Number(this.windowSelect.value)) },
      ...WINDOWS_S.map((seconds) => element("option", { value: seconds, selected: seconds === this.windowS }, seconds < 60 ? `${seconds} s` : `${seconds / 60} min`)),
    );
    this.times = element("span", { class: "dim" });
    this.help = element("p", { class: "dim" }, "Search a register here, or drag one from the tab Registers onto the tab Plots.");
    this.area = element("div", { class: "lanes" });
    const form = element("form", {}, this.search, this.found);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.add(this.search.value.trim());
    });
    this.root = element(
      "div",
      { class: "plots" },
      element(
        "div",
        { class: "bar" },
        form,
        this.windowSelect,
        this.pauseButton,
        element("button", { type: "button", click: () => this.savePicture() }, "Save PNG"),
        element("button", { type: "button", click: () => this.saveTable() }, "Save CSV"),
        this.times,
      ),
      this.help,
      this.area,
    );
    this.root.addEventListener("dragover", (event) => event.preventDefault());
    this.root.addEventListener("drop", (event) => {
      event.preventDefault();
      this.add(event.dataTransfer?.getData("text/plain") ?? "");
    });
    this.makeLanes(stored());
    this.context.connection.onBatch = (batch) => this.take(batch);
    this.stop = context.connection.follow("plots", (numbers) => this.lost(numbers));
    this.timer = setInterval(() => this.request(), 250); // time goes on while no data comes
    this.resize = new ResizeObserver(() => this.request());
    this.resize.observe(this.area);
  }

  close() {
    this.stop();
    clearInterval(this.timer);
    clearTimeout(this.retry);
    this.resize.disconnect();
    this.context.connection.onBatch = () => {};
    for (const source of this.feeds.keys()) this.context.connection.call("plots.follow", { source, paths: [] }).catch(() => {});
  }

  /** Follow all registers again: the connection is new. */
  resume() {
    this.feeds.clear();
    this.byNumber.clear();
    this.followAll();
  }

  /** @param {string} path */
  async add(path) {
    if (!path) return;
    const known = this.lanes.flatMap((lane) => lane.paths);
    if (known.includes(path)) return;
    this.search.value = "";
    this.makeLanes([...this.lanes.map((lane) => lane.paths), [path]]);
    if (!(await this.follow(sourceOf(path)))) this.remove(path);
  }

  /** @param {string} path */
  remove(path) {
    this.makeLanes(this.lanes.map((lane) => lane.paths.filter((one) => one !== path)).filter((paths) => paths.length));
    this.series.delete(path);
    this.colors.delete(path);
    this.follow(sourceOf(path));
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
    this.makeLanes(lanes.filter((paths) => paths.length));
  }

  /** @param {string[][]} wanted The paths of each lane. */
  makeLanes(wanted) {
    sessionStorage.setItem(KEY, JSON.stringify(wanted));
    this.lanes = wanted.map((paths, index) => this.makeLane(paths, index));
    replace(this.area, ...this.lanes.map((lane) => lane.root));
    this.help.hidden = wanted.length > 0;
    this.request();
  }

  /** @param {string[]} paths @param {number} index @returns {Lane} */
  makeLane(paths, index) {
    const canvas = element("canvas", { tabindex: 0, role: "img", "aria-label": `Course of ${paths.join(", ")}` });
    const legend = element("ul", { class: "legend" }, ...paths.map((path) => this.makeEntry(path)));
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

  /** @param {string} path */
  makeEntry(path) {
    const swatch = element("span", { class: "swatch" });
    swatch.style.background = this.color(path);
    const entry = element(
      "li",
      { draggable: "true", "data-path": path, title: "Drag it onto another plot to join them" },
      swatch,
      element("span", { class: "name" }, path),
      element("output", { class: "value" }),
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

  /** @param {HTMLCanvasElement} canvas */
  listen(canvas) {
    const timeAt = (/** @type {MouseEvent} */ event) => {
      const box = canvas.getBoundingClientRect();
      return this.from + ((event.clientX - box.left - LEFT_PX) / (box.width - LEFT_PX)) * (this.to - this.from);
    };
    /** @type {{ time: number, moved: boolean } | null} */
    let drag = null;
    canvas.addEventListener("pointerdown", (event) => {
      drag = { time: timeAt(event), moved: false };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const time = timeAt(event);
      if (drag !== null && Math.abs(time - drag.time) > 0.005 * (this.to - this.from)) {
        drag.moved = true;
        this.pause(true);
        this.shift(drag.time - time);
      }
      this.cursor = timeAt(event);
      this.request();
    });
    canvas.addEventListener("pointerup", () => {
      if (drag !== null && !drag.moved) this.mark = this.mark === null ? this.cursor : null;
      drag = null;
      this.request();
    });
    canvas.addEventListener("pointerleave", () => {
      if (drag !== null) return;
      this.cursor = null;
      this.request();
    });
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(event.deltaY > 0 ? 1.25 : 0.8, timeAt(event));
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
    this.request();
  }

  /** @param {number} factor @param {number} around */
  zoom(factor, around) {
    const span = Math.min(3600, Math.max(0.01, factor * (this.to - this.from)));
    if (this.paused) {
      const share = (around - this.from) / (this.to - this.from);
      this.from = around - share * span;
      this.to = this.from + span;
    } else this.windowS = span;
    this.request();
  }

  /** @param {number} seconds */
  show(seconds) {
    this.windowS = seconds;
    if (this.paused) this.from = this.to - seconds;
    this.request();
  }

  /** @param {boolean} paused */
  pause(paused) {
    this.paused = paused;
    setText(this.pauseButton, paused ? "Live" : "Pause");
    this.request();
  }

  async suggest() {
    const filter = this.search.value;
    const found = await this.context.connection.call("registers.rows", { first: 0, count: 30, filter }).catch(() => ({ rows: [] }));
    if (filter !== this.search.value) return;
    const paths = found.rows.filter((/** @type {any} */ row) => row.type !== undefined).map((/** @type {any} */ row) => row.path);
    replace(this.found, ...paths.map((/** @type {string} */ path) => element("option", { value: path })));
    this.context.connection.call("registers.rows", { first: 0, count: 0 }).catch(() => {});
  }

  async followAll() {
    clearTimeout(this.retry);
    const sources = new Set(this.lanes.flatMap((lane) => lane.paths).map(sourceOf));
    for (const source of sources) if (!this.feeds.has(source)) await this.follow(source);
  }

  /**
   * Follow the registers of a source that are plotted now.
   *
   * @param {string} source
   * @returns {Promise<boolean>} False if the server refused it.
   */
  async follow(source) {
    const paths = this.lanes.flatMap((lane) => lane.paths).filter((path) => sourceOf(path) === source);
    try {
      const feed = await this.context.connection.call("plots.follow", { source, paths });
      const old = this.feeds.get(source);
      if (old !== undefined && old.number !== feed?.number) this.byNumber.delete(old.number);
      this.feeds.delete(source);
      if (feed === null) return true;
      this.feeds.set(source, feed);
      this.byNumber.set(feed.number, feed);
      for (const signal of feed.signals) this.signals.set(signal.path, signal);
      return true;
    } catch (error) {
      if (!this.context.connection.open) return true;
      notify(String(/** @type {Error} */ (error).message), "problem");
      this.retry = setTimeout(() => this.followAll(), RETRY_MS);
      return false;
    }
  }

  /** Follow the sources again whose feeds have ended. @param {number[]} numbers The feeds that are left. */
  lost(numbers) {
    for (const [source, feed] of this.feeds) {
      if (numbers.includes(feed.number)) continue;
      this.feeds.delete(source);
      this.byNumber.delete(feed.number);
    }
    this.followAll();
  }

  /** @param {ArrayBuffer} batch See shmio/endpoints/web/signals.py. */
  take(batch) {
    const view = new DataView(batch);
    const feed = this.byNumber.get(view.getUint32(0, true));
    if (feed === undefined) return;
    const rows = view.getUint32(4, true);
    const before = view.getFloat64(8, true);
    const times = new Float64Array(batch, HEAD_BYTES, rows);
    const most = Math.min(600_000, Math.floor(MAX_SAMPLES / feed.signals.length));
    const marksAt = HEAD_BYTES + 8 * rows * (1 + feed.signals.length);
    feed.signals.forEach(({ path }, index) => {
      let series = this.series.get(path);
      if (series === undefined) this.series.set(path, (series = new Series()));
      const values = new Float64Array(batch, HEAD_BYTES + 8 * rows * (1 + index), rows);
      series.append(before, times, values, new Uint8Array(batch, marksAt + rows * index, rows), most);
    });
    this.lagS = Math.min(this.lagS, Date.now() / 1000 - times[rows - 1]);
    this.request();
  }

  /** Draw soon. */
  request() {
    if (this.asked) return;
    this.asked = true;
    setTimeout(() => requestAnimationFrame(() => this.draw()), Math.max(0, REDRAW_MS - (performance.now() - this.drawnMs)));
  }

  draw() {
    this.asked = false;
    this.drawnMs = performance.now();
    if (!this.paused) {
      this.to = Number.isFinite(this.lagS) ? Date.now() / 1000 - this.lagS : Date.now() / 1000;
      this.from = this.to - this.windowS;
    }
    for (const { paths, canvas, legend } of this.lanes) {
      const scale = devicePixelRatio;
      const { clientWidth: width, clientHeight: height } = canvas;
      if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
      if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
      const pen = canvas.getContext("2d");
      if (pen === null || width === 0) continue;
      pen.setTransform(scale, 0, 0, scale, 0, 0);
      draw(pen, width, height, this.lines(paths), this);
      paths.forEach((path, index) => this.fill(path, legend.children[index]));
    }
    const difference = this.mark !== null && this.cursor !== null ? `, Δt ${(this.cursor - this.mark).toFixed(3)} s` : "";
    setText(this.times, this.cursor === null ? "" : `${clock(this.cursor)}${difference}`);
  }

  /** @param {string[]} paths */
  lines(paths) {
    return paths.map((path) => ({
      series: this.series.get(path) ?? new Series(),
      color: this.color(path),
      steps: this.signals.get(path)?.type === "BOOL",
    }));
  }

  /** Show the value of a signal: at the cursor, else the newest one. @param {string} path @param {Element} entry */
  fill(path, entry) {
    const series = this.series.get(path);
    const signal = this.signals.get(path);
    const unit = signal?.unit ? ` ${signal.unit}` : durations.has(signal?.type ?? "") ? " ms" : "";
    const value = series === undefined ? NaN : series.valueAt(this.cursor ?? this.to);
    const text = Number.isNaN(value) ? "no value" : `${format(value)}${unit}`;
    const change = series !== undefined && this.mark !== null && this.cursor !== null ? value - series.valueAt(this.mark) : NaN;
    setText(entry.children[2], Number.isNaN(change) ? text : `${text} (Δ ${format(change)})`);
  }

  /** Save the plots as a picture. */
  savePicture() {
    const parts = this.lanes.map((lane) => lane.canvas);
    if (!parts.length) return;
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
        const text = `${path} ${this.signals.get(path)?.unit ?? ""}`.trim();
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
    const paths = this.lanes.flatMap((lane) => lane.paths);
    const all = paths.map((path) => this.series.get(path) ?? new Series());
    const next = all.map((series) => series.at(this.from));
    const rows = [["time", ...paths].map(quoted).join(",")];
    for (;;) {
      const times = all.map((series, index) => (next[index] < series.count ? series.times[next[index]] : Infinity));
      const time = Math.min(...times);
      if (time > this.to || time === Infinity) break;
      const cells = all.map((series, index) => {
        if (times[index] !== time) return "";
        const value = series.values[next[index]];
        next[index] += 1;
        return Number.isNaN(value) ? "" : String(value);
      });
      rows.push([new Date(1000 * time).toISOString(), ...cells].join(","));
    }
    this.save(new Blob([`${rows.join("\r\n")}\r\n`], { type: "text/csv" }), "csv");
  }

  /** @param {Blob} blob @param {string} kind */
  save(blob, kind) {
    const address = URL.createObjectURL(blob);
    const stamp = new Date(1000 * this.to).toISOString().replaceAll(":", "-").slice(0, 19);
    element("a", { href: address, download: `${this.context.overview?.instance ?? "plot"}-${stamp}.${kind}` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10_000);
  }
}

const durations = new Set(["TIME", "S5TIME", "TIME_OF_DAY", "LTIME", "LTOD"]);

/** @param {string} path @returns {string} */
function sourceOf(path) {
  return path.split("/")[0];
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
