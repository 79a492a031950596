// The recordings tab: the files of the recorder, what is in them and their damage, and plots of them.

import { clock } from "./chart.js";
import { element, notify, replace, setText } from "./dom.js";
import { bytes, duration } from "./format.js";
import { Lanes } from "./lanes.js";
import { SignalHistory } from "./recorded.js";
import { ReplayPanel } from "./replays.js";

/** @typedef {import("./main.js").Context} Context */
/** @typedef {import("./lanes.js").Signal} Signal */
/**
 * @typedef {{ name: string, size: number, writing: boolean, known: boolean, closed?: boolean, begin_s?: number, end_s?: number,
 *   sources?: string[], damaged?: boolean, problem?: string }} File
 */

const REFRESH_MS = 2000;
const SETTLE_MS = 250; // after the last movement, before a part is read in detail
const MAX_SIGNALS = 32;
const HEADS = ["Name", "Start", "Length", "Size", "Sources", "State"];
const KEY = "recording";

/** @returns {{ name: string, lanes: string[][] }} The recording that was shown last, and its plots. */
function stored() {
  try {
    return JSON.parse(sessionStorage.getItem(KEY) ?? '{"name": "", "lanes": []}');
  } catch {
    return { name: "", lanes: [] };
  }
}

export class RecordingsTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    const { name, lanes } = stored();
    this.name = name;
    /** @type {Map<string, Signal>} */
    this.signals = new Map();
    /** @type {SignalHistory | null} The whole recording. */
    this.overview = null;
    /** @type {SignalHistory | null} The part in view, in detail. */
    this.detail = null;
    /** @type {Map<string, number>} The work of each kind on the server. */
    this.works = new Map();
    this.rows = "";

    this.replays = new ReplayPanel(context);
    this.folder = element("span", { class: "dim" });
    this.body = element("tbody");
    this.title = element("h2");
    this.info = element("p", { class: "info" });
    this.damage = element("ul", { class: "problem" });
    this.checkButton = element("button", { type: "button", click: () => this.toggleCheck() }, "Check for damage");
    this.checkState = element("output", { "aria-label": "Result of the check" });
    this.commands = element("div");
    this.search = element("input", { type: "search", placeholder: "Add a register", "aria-label": "Add a register", list: "recorded-paths", maxlength: 200 });
    this.found = element("datalist", { id: "recorded-paths" });
    this.search.addEventListener("input", () => this.suggest());
    this.progress = element("span", { class: "dim", role: "status" });
    this.lanes = new Lanes({
      series: (path) => this.seriesOf(path),
      signal: (path) => this.signals.get(path),
      marks: () => this.shown?.marks ?? [],
      changed: (wanted) => sessionStorage.setItem(KEY, JSON.stringify({ name: this.name, lanes: wanted })),
      removed: () => {},
      moved: () => this.needDetail(),
      newest: null,
      name: () => this.name.replace(/\.mem$/, ""),
    });
    const form = element("form", {}, this.search, this.found);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.add(this.search.value.trim());
    });
    this.chosen = element(
      "section",
      { hidden: true, "aria-label": "Recording" },
      element("div", { class: "bar" }, this.title, this.checkButton, this.checkState),
      this.info,
      this.damage,
      element("details", {}, element("summary", {}, "Replay it"), this.commands),
      element(
        "div",
        { class: "bar" },
        form,
        element("button", { type: "button", click: () => this.showWhole() }, "Whole recording"),
        element("button", { type: "button", click: () => this.lanes.savePicture() }, "Save PNG"),
        element("button", { type: "button", click: () => this.lanes.saveTable() }, "Save CSV"),
        this.progress,
        this.lanes.times,
      ),
      this.lanes.root,
    );
    const head = element("tr", {}, ...HEADS.map((text) => element("th", { scope: "col" }, text)));
    this.root = element(
      "div",
      { class: "recordings" },
      this.replays.root,
      element("div", { class: "bar" }, element("h2", {}, "Recordings"), this.folder),
      element("div", { class: "scroll" }, element("table", { "aria-label": "recordings" }, element("thead", {}, head), this.body)),
      this.chosen,
    );
    this.lanes.make(lanes);
    this.timer = setInterval(() => this.refresh(), REFRESH_MS);
  }

  close() {
    clearInterval(this.timer);
    clearTimeout(this.settling);
    this.lanes.close();
    this.replays.close();
    for (const kind of [...this.works.keys()]) this.stop(kind);
  }

  resume() {
    this.works.clear(); // they ended with the old connection
    this.refresh();
    this.replays.refresh();
    if (this.name) this.choose(this.name);
  }

  async refresh() {
    try {
      this.fill(await this.context.connection.call("recordings.files"));
    } catch {
      // the connection is lost: the head line says so
    }
  }

  /** @param {{ folder: string | null, files: File[] }} found */
  fill(found) {
    const text = JSON.stringify([found, this.name]);
    if (text === this.rows) return; // keeps the user's selection
    this.rows = text;
    setText(this.folder, found.folder ?? "this instance has no recorder; add [recorder] to its configuration");
    const rows = found.files.map((file) => {
      const length = file.begin_s && file.end_s ? duration(file.end_s - file.begin_s) : "";
      const name = element("button", { type: "button", click: () => this.choose(file.name) }, file.name);
      const cells = [name, file.begin_s ? moment(file.begin_s) : "", length, bytes(file.size), (file.sources ?? []).join(", "), state(file)];
      return element(
        "tr",
        { "aria-selected": String(file.name === this.name), click: () => file.name !== this.name && this.choose(file.name) },
        ...cells.map((cell) => element("td", {}, cell)),
      );
    });
    const none = element("tr", {}, element("td", { class: "dim", colspan: HEADS.length }, "no recordings"));
    replace(this.body, ...(rows.length ? rows : [none]));
  }

  /** Show a recording. @param {string} name */
  async choose(name) {
    if (name !== this.name) {
      for (const kind of [...this.works.keys()]) this.stop(kind);
      this.name = name;
      this.lanes.make([]);
      setText(this.checkState, "");
    }
    this.overview = this.detail = null;
    this.rows = "";
    this.refresh();
    this.chosen.hidden = false;
    setText(this.title, name);
    setText(this.info, "reading…");
    replace(this.damage);
    replace(this.commands);
    this.showWhole();
    try {
      const found = await this.context.connection.call("recordings.describe", { name });
      if (name === this.name) this.describe(found);
    } catch (error) {
      if (name === this.name) setText(this.info, String(/** @type {Error} */ (error).message));
    }
  }

  /** @param {any} found See shmio/recording/description.py. */
  describe(found) {
    const missed = found.gap_count ? `${found.missed_frames} frames and ${found.missed_events} events missed in ${found.gap_count} gaps` : "nothing missed";
    const blocks = found.blocks.map((/** @type {any} */ one) => {
      const rate = one.rate_hz ? ` at ${one.rate_hz.toFixed(1)} Hz` : "";
      return `${one.source}: ${one.registers ?? "unknown"} registers, ${one.frames} frames${rate}, ${one.events} events`;
    });
    const by = `instance ${found.instance}, mode ${found.mode}, shmio ${found.version}, on ${found.host}`;
    const end = found.closed ? "closed" : "not closed: it is being written, or its recorder was killed";
    const span = found.from ? `${moment(Date.parse(found.from) / 1000)}, ${duration(found.duration_s)}, ${bytes(found.size)}` : "it has no frames";
    setText(this.info, [span, end, by, missed, ...blocks].join(" · "));
    if (found.damage.length) this.showDamage(found.damage);
    const { beside, instead } = found.replay;
    replace(
      this.commands,
      element("p", {}, "This page cannot start or stop a cell. To replay the recording beside this instance, with a page of its own, run on this instance's host:"),
      this.command(beside.replace("PORT", String(Number(location.port || 8080) + 1))),
      element("p", {}, "To replay it in place of this instance, with all its interfaces:"),
      this.command(instead),
      element("p", {}, "This tab of the replay's page then pauses, moves and speeds it up."),
    );
  }

  /** @param {string} text */
  command(text) {
    const copy = async () => {
      try {
        await navigator.clipboard.writeText(text);
        notify("copied");
      } catch {
        notify("The browser lets a page copy only over https or on the same host. Select the text and copy it yourself.", "problem");
      }
    };
    return element("div", { class: "command" }, element("pre", {}, text), element("button", { type: "button", click: copy }, "Copy"));
  }

  async suggest() {
    const filter = this.search.value;
    const { name } = this;
    const found = await this.call("registers", { name, filter }).catch(() => []);
    if (filter !== this.search.value || name !== this.name) return;
    replace(this.found, ...found.map((/** @type {Signal} */ one) => element("option", { value: one.path })));
  }

  /** @param {string} path */
  async add(path) {
    const { paths } = this.lanes;
    if (!path || paths.includes(path)) return;
    if (paths.length >= MAX_SIGNALS) {
      notify(`A plot of a recording has at most ${MAX_SIGNALS} registers. Remove some first.`, "problem");
      return;
    }
    this.search.value = "";
    this.lanes.make([...this.lanes.lanes.map((lane) => lane.paths), [path]]);
    const { from, to } = this.lanes;
    const known = this.overview !== null;
    if (!(await this.readOverview())) this.lanes.remove(path);
    else if (known) this.lanes.showRange(from, to);
  }

  async showWhole() {
    if (this.overview !== null) this.lanes.showRange(this.overview.from, this.overview.to);
    else await this.readOverview();
  }

  /** Read all of the recording at the width of the plot. @returns {Promise<boolean>} False if the server refused it. */
  async readOverview() {
    const { paths } = this.lanes;
    if (!paths.length) return true;
    this.detail = null;
    return this.read("overview", { paths }, (history) => {
      this.overview = history;
      this.lanes.showRange(history.from, history.to);
    });
  }

  /** Read what is in view in detail, if the overview is too coarse. */
  needDetail() {
    clearTimeout(this.settling);
    this.settling = setTimeout(() => {
      const { overview, detail } = this;
      const { from, to } = this.lanes;
      if (overview === null || to - from >= 0.9 * (overview.to - overview.from)) return;
      const [first, last] = [Math.max(from, overview.from), Math.min(to, overview.to)];
      if (first >= last || (detail !== null && detail.serves(first, last))) return;
      const margin = (to - from) / 2;
      const given = { paths: this.lanes.paths, from_s: Math.max(0, first - margin), to_s: last + margin };
      this.read("detail", given, (history) => {
        this.detail = history;
      });
    }, SETTLE_MS);
  }

  /**
   * Read a history, in place of what was being read of this kind.
   *
   * @param {string} kind
   * @param {{ paths: string[], from_s?: number, to_s?: number }} given
   * @param {(history: SignalHistory) => void} begin
   * @returns {Promise<boolean>} False if the server refused it.
   */
  async read(kind, given, begin) {
    this.stop(kind);
    const { name } = this;
    try {
      const columns = (kind === "detail" ? 2 : 1) * this.lanes.columns;
      const plot = await this.call("plot", { name, columns, ...given });
      if (name !== this.name) {
        this.call("stop", { number: plot.number }).catch(() => {});
        return true;
      }
      this.stop(kind);
      this.works.set(kind, plot.number);
      for (const signal of plot.signals) this.signals.set(signal.path, signal);
      const history = new SignalHistory(given.paths, plot.from_s, plot.to_s);
      begin(history);
      await history.read(this.context.connection, "recordings.more", plot.number, () => {
        setText(this.progress, history.share < 1 ? `${Math.floor(100 * history.share)} % read` : "");
        this.lanes.request();
        return this.works.get(kind) === plot.number;
      });
      if (this.works.get(kind) !== plot.number) return true;
      history.whole = true;
      if (history.damage.length) this.showDamage(history.damage);
      setText(this.progress, "");
      this.lanes.request();
      this.works.delete(kind);
      return true;
    } catch (error) {
      if (this.context.connection.open && name === this.name) setText(this.progress, String(/** @type {Error} */ (error).message));
      return false;
    }
  }

  /** @returns {SignalHistory | null} What is drawn: the detail once all of it is here and it has what is in view, else the overview. */
  get shown() {
    const { overview, detail } = this;
    const { from, to } = this.lanes;
    if (detail === null || !detail.whole || overview === null) return overview;
    return detail.from <= Math.max(from, overview.from) && detail.to >= Math.min(to, overview.to) ? detail : overview;
  }

  /** @param {string} path */
  seriesOf(path) {
    const series = this.shown?.series.get(path);
    return series === undefined ? [] : [series];
  }

  async toggleCheck() {
    if (this.works.has("check")) {
      this.stop("check");
      setText(this.checkState, "stopped");
      setText(this.checkButton, "Check for damage");
      return;
    }
    const { name } = this;
    let number = null;
    try {
      number = await this.call("verify", { name });
      if (name !== this.name) {
        this.call("stop", { number }).catch(() => {});
        return; // the user has chosen another recording
      }
      this.works.set("check", number);
      setText(this.checkButton, "Stop");
      for (;;) {
        const part = await this.call("more", { number });
        if (this.works.get("check") !== number) return;
        if (part === null) break;
        if (part.chunks === undefined) setText(this.checkState, `${Math.floor(100 * part.share)} % checked`);
        else this.showResult(part);
      }
    } catch (error) {
      if (name !== this.name || (this.works.get("check") ?? null) !== number) return; // it was stopped, or another one runs
      setText(this.checkState, String(/** @type {Error} */ (error).message));
    }
    this.works.delete("check");
    setText(this.checkButton, "Check for damage");
  }

  /** @param {{ chunks: number, messages: number, damage: string[] }} part */
  showResult(part) {
    const whole = `${part.chunks} chunks with ${part.messages} messages are whole`;
    setText(this.checkState, part.damage.length ? `damaged; ${whole}` : `no damage: ${whole}`);
    if (part.damage.length) this.showDamage(part.damage);
  }

  /** @param {string[]} damage */
  showDamage(damage) {
    replace(this.damage, ...damage.map((text) => element("li", {}, text)));
  }

  /** @param {string} kind */
  stop(kind) {
    const number = this.works.get(kind);
    this.works.delete(kind);
    if (kind === "check") setText(this.checkButton, "Check for damage");
    if (number !== undefined) this.call("stop", { number }).catch(() => {});
  }

  /** @param {string} name @param {object} given */
  call(name, given) {
    return this.context.connection.call(`recordings.${name}`, given);
  }
}

/** @param {File} file */
function state(file) {
  if (file.problem) return element("span", { class: "problem", title: file.problem }, file.writing ? "being written" : `not readable: ${file.problem}`);
  const damaged = file.damaged ? ", damaged" : "";
  if (file.writing) return element("span", { class: "good" }, `being written${damaged}`);
  if (!file.known) return element("span", { class: "dim" }, "…");
  const text = file.closed ? `closed${damaged}` : `not closed${damaged}`;
  return element("span", { class: file.damaged ? "problem" : file.closed ? "" : "uncertain", title: file.closed ? "" : "its recorder was killed" }, text);
}

/** @param {number} time_s @returns {string} A date and time where the user is. */
function moment(time_s) {
  return `${new Date(1000 * time_s).toLocaleDateString("en-CA")} ${clock(time_s)}`;
}
