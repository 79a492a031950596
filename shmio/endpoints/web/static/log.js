// The log tab: the end of the log files of all processes.

import { element, replace, setText } from "./dom.js";

/** @typedef {import("./main.js").Context} Context */
/** @typedef {{ time: string | null, level: string | null, process: string | null, pid: number | null, text: string }} Line */

const REFRESH_MS = 2000;
const FILTER_DELAY_MS = 200;

export class LogTab {
  /** @param {Context} context @param {{ count?: number }} [more] `count`: number of lines. */
  constructor(context, { count = 200 } = {}) {
    this.context = context;
    this.count = count;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.typing = undefined;
    this.shown = "";
    const names = (context.overview?.processes ?? []).map((/** @type {any} */ one) => one.name);
    this.filter = element("input", {
      type: "search",
      placeholder: "Filter",
      "aria-label": "Filter",
      maxlength: 200,
      input: () => {
        clearTimeout(this.typing);
        this.typing = setTimeout(() => this.resume(), FILTER_DELAY_MS);
      },
    });
    this.process = element(
      "select",
      { "aria-label": "Process", change: () => this.resume() },
      element("option", { value: "" }, "all processes"),
      ...["supervisor", ...names].map((name) => element("option", {}, name)),
    );
    this.lines = element("pre", { class: "log", tabindex: 0, "aria-label": "Log" });
    this.problem = element("span", { class: "problem" });
    this.root = element("div", { class: "logs" }, element("div", { class: "bar" }, this.filter, this.process, this.problem), this.lines);
    this.timer = setInterval(() => this.resume(), REFRESH_MS);
  }

  close() {
    clearInterval(this.timer);
    clearTimeout(this.typing);
  }

  async resume() {
    const given = { filter: this.filter.value, process: this.process.value, count: this.count };
    try {
      this.show(await this.context.connection.call("log.lines", given));
      setText(this.problem, "");
    } catch (error) {
      setText(this.problem, this.context.connection.open ? String(/** @type {Error} */ (error).message) : "");
    }
  }

  /** @param {Line[]} lines */
  show(lines) {
    const text = JSON.stringify(lines);
    if (text === this.shown) return; // keeps the user's selection
    this.shown = text;
    const { lines: view } = this;
    const atEnd = view.scrollTop + view.clientHeight >= view.scrollHeight - 4;
    const made = lines.map((line) => {
      if (line.time === null) return element("div", { class: "dim" }, line.text);
      const level = line.level === "ERROR" || line.level === "CRITICAL" ? "bad" : line.level === "WARNING" ? "uncertain" : "dim";
      const time = new Date(line.time.replace(/(\.\d{3})\d*Z$/, "$1Z")).toLocaleTimeString("en-GB");
      return element("div", { title: line.time }, `${time} `, element("span", { class: level }, (line.level ?? "").padEnd(7)), ` ${line.process}: ${line.text}`);
    });
    replace(view, ...made);
    if (atEnd) view.scrollTop = view.scrollHeight;
  }
}
