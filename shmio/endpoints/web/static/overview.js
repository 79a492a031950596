// The overview tab: processes and sources.

import { element, notify, replace, setText } from "./dom.js";
import { bytes, duration, fixed } from "./format.js";

/** @typedef {import("./main.js").Context} Context */

const PROCESS = ["Process", "Kind", "State", "pid", "Restarts", "CPU %", "Memory", "Up", "Note", "Counters", ""];
const SOURCE = ["Source", "Quality", "Reason", "Registers", "Period ms", "Rate Hz", "Cycle", "Overruns", "Round trip ms", "Age", "Lost / recovered in 1, 10, 30 min"];
const ALERT = ["Alert", "Severity", "Text", "Reason", "Active for"];
/** The class of each severity. @type {Record<string, string>} */
const SEVERITY = { warning: "uncertain", critical: "bad" };

/** Tables with one row for each process and each source. Rows stay, so that a selection survives an update. */
export class OverviewTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    /** @type {Map<string, HTMLButtonElement>} */
    this.buttons = new Map();
    this.sources = new Table(SOURCE, "sources");
    this.processes = new Table(PROCESS, "processes");
    this.alerts = new Table(ALERT, "alerts");
    this.alertsPart = element("div", { hidden: true }, element("h2", {}, "Active alerts"), this.alerts.root);
    this.root = element(
      "div",
      {},
      this.alertsPart,
      element("h2", {}, "Sources"),
      this.sources.root,
      element("h2", {}, "Processes"),
      this.processes.root,
    );
    this.stop = context.connection.follow("overview", (data) => this.update(data));
    if (context.overview !== null) this.update(context.overview);
  }

  close() {
    this.stop();
  }

  /** @param {any} overview */
  update(overview) {
    const sources = overview.processes.filter((/** @type {any} */ one) => "quality" in one);
    this.sources.update(
      sources.map((/** @type {any} */ one) => [
        one.name,
        [one.quality, one.quality],
        one.reason,
        one.registers,
        fixed(one.period_ms, 1),
        fixed(one.rate_hz, 1),
        one.cycle ?? "",
        one.overruns,
        fixed(one.round_trip_ms, 2),
        one.age_s === null ? "" : duration(one.age_s),
        one.lost.map((/** @type {number} */ count, /** @type {number} */ i) => `${count} / ${one.recovered[i]}`).join(", "),
      ]),
    );
    this.alertsPart.hidden = overview.alerts.length === 0;
    this.alerts.update(
      overview.alerts.map((/** @type {any} */ one) => [
        one.name,
        [one.severity, SEVERITY[one.severity] ?? ""],
        one.text,
        one.reason,
        duration(Math.max(0, one.active_s)),
      ]),
    );
    this.processes.update(
      overview.processes.map((/** @type {any} */ one) => [
        one.name,
        one.kind,
        [one.state, one.state],
        one.pid ?? "",
        one.restarts,
        fixed(one.cpu_percent, 1),
        bytes(one.memory_bytes),
        one.pid === null ? "" : duration(one.uptime_s),
        one.note,
        Object.entries(one.counters).map(([name, value]) => `${name.replaceAll("_", " ")} ${value}`).join(", "),
        this.restartButton(one.name),
      ]),
    );
  }

  /** @param {string} name @returns {HTMLButtonElement} The button that restarts a process; it stays the same. */
  restartButton(name) {
    let button = this.buttons.get(name);
    if (button === undefined) {
      const allowed = this.context.may("control");
      button = element(
        "button",
        { type: "button", "aria-label": `Restart ${name}`, disabled: !allowed, title: allowed ? null : "your roles do not allow to restart a process", click: () => this.restart(name) },
        "Restart",
      );
      this.buttons.set(name, button);
    }
    return button;
  }

  /** @param {string} name */
  async restart(name) {
    if (!confirm(`Restart ${name}?`)) return;
    try {
      await this.context.connection.call("overview.restart", { name });
      notify(`${name} runs again`);
    } catch (error) {
      notify(name === "web" ? "This page connects again as soon as its server runs." : String(/** @type {Error} */ (error).message), name === "web" ? "info" : "problem");
    }
  }
}

/** A table whose rows are named by their first cell. */
class Table {
  /** @param {string[]} heads @param {string} name */
  constructor(heads, name) {
    this.body = element("tbody");
    const head = element("tr", {}, ...heads.map((text) => element("th", { scope: "col" }, text)));
    this.root = element("table", { "aria-label": name, id: name }, element("thead", {}, head), this.body);
  }

  /** @param {(string | number | [string, string] | HTMLElement)[][]} rows A pair is a text and its class. */
  update(rows) {
    while (this.body.rows.length > rows.length) this.body.deleteRow(-1);
    rows.forEach((cells, index) => {
      const row = this.body.rows[index] ?? this.body.insertRow();
      cells.forEach((cell, column) => {
        const target = row.cells[column] ?? row.insertCell();
        if (cell instanceof HTMLElement) {
          if (target.firstChild !== cell) replace(target, cell);
          return;
        }
        const [text, style] = Array.isArray(cell) ? cell : [String(cell), typeof cell === "number" ? "number" : ""];
        setText(target, text);
        if (target.className !== style) target.className = style;
      });
    });
    if (rows.length === 0) replace(this.body, element("tr", {}, element("td", { class: "dim" }, "none")));
  }
}
