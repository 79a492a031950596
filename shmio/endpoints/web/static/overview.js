// The overview tab: processes and sources.

import { element, notify } from "./dom.js";
import { bytes, duration, fixed } from "./format.js";
import { LogTab } from "./log.js";
import { Table } from "./table.js";

/** @typedef {import("./main.js").Context} Context */

const PROCESS = ["Process", "Kind", "State", "pid", "Restarts", "CPU %", "Memory", "Running for", "Note", ""];
const SOURCE = ["Source", "Quality", "Registers", "Period ms", "Rate Hz", "Overruns", "Round trip ms", "Age", "Slowest reader", "Disconnected in 1, 10, 30 min", "Connected in 1, 10, 30 min"];
const CLIENT = ["Endpoint", "Connections", "Clients"];
/** Kinds of processes in words. @type {Record<string, string>} */
const KINDS = { source: "source", emulator: "emulator", grpc: "gRPC", mqtt: "MQTT", opcua: "OPC UA", web: "web page", recorder: "recorder", alerts: "alerts" };
const LOG_LINES = 50;
/** A reader that is this many seconds behind is marked. */
const LATE_S = 1;
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
    this.clients = new Table(CLIENT, "clients");
    this.log = new LogTab(context, { count: LOG_LINES });
    this.alertsPart = element("div", { hidden: true }, element("h2", {}, "Active alerts"), this.alerts.root);
    this.root = element(
      "div",
      { class: "overview" },
      this.alertsPart,
      element("h2", {}, "Sources"),
      this.sources.root,
      element("h2", {}, "Processes"),
      this.processes.root,
      element("h2", {}, "Clients"),
      this.clients.root,
      element("h2", {}, "End of the log"),
      this.log.root,
    );
    this.stop = context.connection.follow("overview", (data) => this.update(data));
    if (context.overview !== null) this.update(context.overview);
  }

  close() {
    this.stop();
    this.log.close();
  }

  resume() {
    this.log.resume();
  }

  /** @param {any} overview */
  update(overview) {
    const sources = overview.processes.filter((/** @type {any} */ one) => "quality" in one);
    this.sources.update(
      sources.map((/** @type {any} */ one) => [
        one.name,
        [one.reason ? `${one.quality}: ${one.reason}` : one.quality, one.quality],
        one.registers,
        [fixed(one.period_ms, 1), "number"],
        [fixed(one.rate_hz, 1), "number"],
        one.overruns,
        [fixed(one.round_trip_ms, 2), "number"],
        [one.age_s === null ? "" : duration(one.age_s), "number"],
        slowest(one.readers),
        [one.lost.join(", "), "number"],
        [one.recovered.join(", "), "number"],
      ]),
    );
    this.updateClients(overview);
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
        [one.name, "", counters(one)],
        KINDS[one.kind] ?? one.kind,
        [one.state, one.state],
        one.pid ?? "",
        one.restarts,
        [fixed(one.cpu_percent, 1), "number"],
        [bytes(one.memory_bytes), "number"],
        [one.pid === null ? "" : duration(one.uptime_s), "number"],
        [one.note, "note"],
        this.restartButton(one.name),
      ]),
    );
  }

  /** @param {any} overview */
  updateClients(overview) {
    this.clients.update(
      overview.clients.map((/** @type {any} */ one) => [
        one.endpoint,
        one.connections,
        one.clients.map((/** @type {any} */ client) => (client.connections > 1 ? `${client.client} (${client.connections})` : client.client)).join(", "),
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
        { type: "button", "aria-label": `Restart ${name}`, disabled: !allowed, title: allowed ? null : "your roles do not allow you to restart a process", click: () => this.restart(name) },
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

/** @param {any} process @returns {string} What the process has counted. */
function counters(process) {
  return Object.entries(process.counters).map(([name, value]) => `${name.replaceAll("_", " ")}: ${value}`).join("\n");
}

/**
 * @param {{ process: string, frames: number, lag_s: number }[]} readers The processes that read a source, the slowest first.
 * @returns {[string, string, string]} The slowest one, its class, and a tooltip with all of them.
 */
function slowest(readers) {
  const texts = readers.map(({ process, frames, lag_s }) => `${process}: ${frames} frames, ${duration(lag_s)}`);
  return [texts[0] ?? "none", readers.length > 0 && readers[0].lag_s >= LATE_S ? "uncertain" : "", texts.join("\n")];
}
