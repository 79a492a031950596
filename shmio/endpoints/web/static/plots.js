// The plots tab: registers over time, live, and their past from the recording of this run.

import { element, notify, setText } from "./dom.js";
import { Feeds, sourceOf } from "./feeds.js";
import { Lanes } from "./lanes.js";
import { SignalHistory } from "./recorded.js";
import { suggest } from "./suggest.js";

/** @typedef {import("./main.js").Context} Context */
/** @typedef {import("./series.js").Series} Series */

const MAX_SIGNALS = 200;
const MAX_SAMPLES = 4_000_000;
const MAX_PAST = 32; // registers of a source whose past is read
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
    /** @type {Feeds} */
    this.feeds = new Feeds(context.connection, () => this.lanes.paths, () => this.lanes.request(), MAX_SAMPLES);
    /** @type {Map<string, SignalHistory>} The past of each source. */
    this.pasts = new Map();
    /** @type {Map<string, SignalHistory>} The past of each source that was requested last. */
    this.wanted = new Map();

    this.search = element("input", { type: "search", placeholder: "Add a register", "aria-label": "Add a register", list: "plot-paths", maxlength: 200 });
    this.found = element("datalist", { id: "plot-paths" });
    this.search.addEventListener("input", () => suggest(context.connection, this.search, this.found));
    this.lanes = new Lanes({
      series: (path) => this.allSeries(path),
      signal: (path) => this.feeds.signals.get(path),
      marks: () => [],
      changed: (lanes) => {
        sessionStorage.setItem(KEY, JSON.stringify(lanes));
        this.help.hidden = lanes.length > 0;
      },
      removed: (path) => {
        this.feeds.series.delete(path);
        this.feeds.follow(sourceOf(path));
      },
      moved: () => this.needPast(),
      newest: () => (Number.isFinite(this.feeds.lagS) ? Date.now() / 1000 - this.feeds.lagS : Date.now() / 1000),
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
    this.timer = setInterval(() => this.lanes.request(), 250); // time goes on while no data comes
  }

  close() {
    this.feeds.close();
    clearInterval(this.timer);
    clearTimeout(this.settling);
    this.lanes.close();
  }

  /** Follow all registers again: the connection is new. */
  resume() {
    this.feeds.resume();
  }

  /** @param {string} path */
  async add(path) {
    if (!path || this.lanes.paths.includes(path)) return;
    this.search.value = "";
    this.lanes.make([...this.lanes.lanes.map((lane) => lane.paths), [path]]);
    if (!(await this.feeds.follow(sourceOf(path)))) this.lanes.remove(path);
    else this.needPast();
  }

  /** @param {string} path @returns {Series[]} Its past, and what came since the page follows it. */
  allSeries(path) {
    const past = this.pasts.get(sourceOf(path))?.series.get(path);
    const live = this.feeds.series.get(path);
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
    const begun = paths.map((path) => this.feeds.series.get(path)).filter((series) => series !== undefined && series.count > 0);
    const until = Math.min(this.lanes.to, ...begun.map((series) => series?.times[0] ?? Infinity));
    const { from } = this.lanes;
    const old = this.pasts.get(source);
    if (from >= until || (old !== undefined && paths.every((path) => old.series.has(path)) && old.serves(from, until))) return;
    const margin = (until - from) / 2;
    const past = new SignalHistory(paths, from - margin, until === this.lanes.to ? until + margin : until);
    const given = { source, paths, from_s: Math.max(0, past.from), to_s: past.to, columns: 2 * this.lanes.columns };
    this.wanted.set(source, past);
    try {
      setText(this.pastState, "reading the recording…");
      const numbers = await this.context.connection.call("plots.past", given);
      for (const number of numbers) {
        await past.read(this.context.connection, "plots.more", number, () => this.wanted.get(source) === past);
      }
      if (this.wanted.get(source) !== past) return;
      this.pasts.set(source, past);
      setText(this.pastState, numbers.length ? "" : "there is no recording of this time");
      this.lanes.request();
    } catch (error) {
      if (this.wanted.get(source) === past) setText(this.pastState, String(/** @type {Error} */ (error).message));
    }
  }

}

/** @param {number} seconds @returns {string} */
function spanText(seconds) {
  if (seconds < 60) return `${seconds} s`;
  return seconds < 3600 ? `${seconds / 60} min` : `${seconds / 3600} h`;
}
