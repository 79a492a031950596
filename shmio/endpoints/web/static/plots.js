// The plots tab: registers over time, live, and their past from the recording of this run.

import { element, notify, replace, setText } from "./dom.js";
import { Lanes } from "./lanes.js";
import { Course } from "./recorded.js";
import { Series, batchNumber, readBatch } from "./series.js";

/** @typedef {import("./main.js").Context} Context */
/** @typedef {import("./lanes.js").Signal} Signal */
/** @typedef {{ number: number, signals: Signal[] }} Feed */

const MAX_SIGNALS = 200;
const MAX_SAMPLES = 4_000_000;
const MAX_PAST = 32; // registers of a source whose past is read
const RETRY_MS = 3000;
const SETTLE_MS = 250; // after the last movement, before the past is requested
const WINDOWS_S = [2, 8, 30, 120, 600, 3600];
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
    /** @type {Map<string, Course>} The past of each source. */
    this.pasts = new Map();
    /** @type {Map<string, Course>} The past of each source that was requested last. */
    this.wanted = new Map();
    this.lagS = Infinity; // of this computer's clock against the server's times

    this.search = element("input", { type: "search", placeholder: "Add a register", "aria-label": "Add a register", list: "plot-paths", maxlength: 200 });
    this.found = element("datalist", { id: "plot-paths" });
    this.search.addEventListener("input", () => this.suggest());
    this.lanes = new Lanes({
      series: (path) => this.allSeries(path),
      signal: (path) => this.signals.get(path),
      marks: () => [],
      changed: (lanes) => {
        sessionStorage.setItem(KEY, JSON.stringify(lanes));
        this.help.hidden = lanes.length > 0;
      },
      removed: (path) => {
        this.series.delete(path);
        this.follow(sourceOf(path));
      },
      moved: () => this.needPast(),
      newest: () => (Number.isFinite(this.lagS) ? Date.now() / 1000 - this.lagS : Date.now() / 1000),
      name: () => this.context.overview?.instance ?? "plot",
    });
    this.windowSelect = element(
      "select",
      { "aria-label": "Time span", change: () => this.lanes.show(Number(this.windowSelect.value)) },
      ...WINDOWS_S.map((seconds) => element("option", { value: seconds, selected: seconds === this.lanes.windowS }, spanText(seconds))),
    );
    this.help = element("p", { class: "dim" }, "Search a register here, or drag one from the tab Registers onto the tab Plots.");
    this.pastState = element("span", { class: "dim", role: "status" });
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
        this.lanes.pauseButton,
        element("button", { type: "button", click: () => this.lanes.savePicture() }, "Save PNG"),
        element("button", { type: "button", click: () => this.lanes.saveTable() }, "Save CSV"),
        this.pastState,
        this.lanes.times,
      ),
      this.help,
      this.lanes.root,
    );
    this.root.addEventListener("dragover", (event) => event.preventDefault());
    this.root.addEventListener("drop", (event) => {
      event.preventDefault();
      this.add(event.dataTransfer?.getData("text/plain") ?? "");
    });
    this.lanes.make(stored());
    this.context.connection.onBatch = (batch) => this.take(batch);
    this.stop = context.connection.follow("plots", (numbers) => this.lost(numbers));
    this.timer = setInterval(() => this.lanes.request(), 250); // time goes on while no data comes
  }

  close() {
    this.stop();
    clearInterval(this.timer);
    clearTimeout(this.retry);
    clearTimeout(this.settling);
    this.lanes.close();
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
    if (!path || this.lanes.paths.includes(path)) return;
    this.search.value = "";
    this.lanes.make([...this.lanes.lanes.map((lane) => lane.paths), [path]]);
    if (!(await this.follow(sourceOf(path)))) this.lanes.remove(path);
    else this.needPast();
  }

  /** @param {string} path @returns {Series[]} Its past, and what came since the page follows it. */
  allSeries(path) {
    const past = this.pasts.get(sourceOf(path))?.series.get(path);
    const live = this.series.get(path);
    return [past, live].filter((series) => series !== undefined);
  }

  /** Read the past from the recording, if it is in view and not here. */
  needPast() {
    clearTimeout(this.settling);
    this.settling = setTimeout(() => {
      for (const source of new Set(this.lanes.paths.map(sourceOf))) this.readPast(source);
    }, SETTLE_MS);
  }

  /** @param {string} source */
  async readPast(source) {
    const paths = this.lanes.paths.filter((path) => sourceOf(path) === source).slice(0, MAX_PAST);
    const begun = paths.map((path) => this.series.get(path)).filter((series) => series !== undefined && series.count > 0);
    const until = Math.min(this.lanes.to, ...begun.map((series) => series?.times[0] ?? Infinity));
    const { from } = this.lanes;
    const old = this.pasts.get(source);
    if (from >= until || (old !== undefined && paths.every((path) => old.series.has(path)) && old.serves(from, until))) return;
    const margin = (until - from) / 2;
    const course = new Course(paths, from - margin, until === this.lanes.to ? until + margin : until);
    const given = { source, paths, from_s: Math.max(0, course.from), to_s: course.to, columns: 2 * this.lanes.columns };
    this.wanted.set(source, course);
    try {
      setText(this.pastState, "reading the recording…");
      const numbers = await this.context.connection.call("plots.past", given);
      for (const number of numbers) {
        await course.read(this.context.connection, "plots.more", number, () => this.wanted.get(source) === course);
      }
      if (this.wanted.get(source) !== course) return;
      this.pasts.set(source, course);
      setText(this.pastState, numbers.length ? "" : "there is no recording of this time");
      this.lanes.request();
    } catch (error) {
      if (this.wanted.get(source) === course) setText(this.pastState, String(/** @type {Error} */ (error).message));
    }
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
    const sources = new Set(this.lanes.paths.map(sourceOf));
    for (const source of sources) if (!this.feeds.has(source)) await this.follow(source);
  }

  /**
   * Follow the registers of a source that are plotted now.
   *
   * @param {string} source
   * @returns {Promise<boolean>} False if the server refused it.
   */
  async follow(source) {
    const paths = this.lanes.paths.filter((path) => sourceOf(path) === source);
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
    const feed = this.byNumber.get(batchNumber(batch));
    if (feed === undefined) return;
    const { before, times, columns } = readBatch(batch, feed.signals.length);
    const most = Math.min(600_000, Math.floor(MAX_SAMPLES / feed.signals.length));
    feed.signals.forEach(({ path }, index) => {
      let series = this.series.get(path);
      if (series === undefined) this.series.set(path, (series = new Series()));
      series.append(before, times, columns[index].values, columns[index].marks, most);
    });
    this.lagS = Math.min(this.lagS, Date.now() / 1000 - times[times.length - 1]);
    this.lanes.request();
  }
}

/** @param {string} path @returns {string} */
function sourceOf(path) {
  return path.split("/")[0];
}

/** @param {number} seconds @returns {string} */
function spanText(seconds) {
  if (seconds < 60) return `${seconds} s`;
  return seconds < 3600 ? `${seconds / 60} min` : `${seconds / 3600} h`;
}
