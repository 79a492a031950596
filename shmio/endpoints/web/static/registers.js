// The registers tab: a virtual table of the tree of all registers. The server sends only the visible rows.

import { element, notify, replace, setText } from "./dom.js";
import { duration } from "./format.js";
import { plot } from "./plots.js";
import { VirtualRows } from "./virtual.js";

/** @typedef {import("./main.js").Context} Context */
/**
 * @typedef {{ path: string, name: string, depth: number, expandable: boolean, type?: string, unit?: string, comment?: string,
 *   writable?: boolean, overridden?: boolean }} Row
 */
/** @typedef {[string | null, string, string, string, number | null]} Value Text, quality, reason, provenance, age in s when it was sent. */

const FILTER_DELAY_MS = 200;

export class RegistersTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    /** @type {Set<string>} */
    this.expanded = new Set(JSON.parse(sessionStorage.getItem("expanded") ?? "[]"));
    this.untouched = this.expanded.size === 0; // then all sources are expanded
    this.first = 0;
    this.total = 0;
    /** @type {Row[]} */
    this.rows = [];
    /** @type {Record<string, Value>} */
    this.values = {};
    this.valuesMs = 0;
    this.timer = setInterval(() => this.fill(), 1000); // ages grow while no values come
    this.asked = 0;
    this.answered = 0;
    /** @type {Row | null} The marked row. The form below the table writes this register, and no other. */
    this.marked = null;
    /** @type {HTMLElement | null} */
    this.present = null;
    this.form = ""; // what the form shows: the register, and what the user may do with it

    this.filter = element("input", {
      type: "search",
      placeholder: "Search path or comment",
      "aria-label": "Search",
      maxlength: 200,
      input: () => {
        clearTimeout(this.typing);
        this.typing = setTimeout(() => this.restart(), FILTER_DELAY_MS);
      },
    });
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.typing = undefined;
    this.count = element("span", { class: "dim" });
    this.virtual = new VirtualRows({ role: "treegrid", "aria-label": "Registers" }, () => this.request());
    this.view = this.virtual.root;
    this.body = this.virtual.body;
    this.view.addEventListener("keydown", (event) => this.key(event));
    this.detail = element("form", { class: "detail", "aria-label": "Register" });
    this.detail.addEventListener("submit", (event) => event.preventDefault());
    const heads = ["Register", "Value", "Quality", "Origin", "Age", "Type", "Comment"].map((text) => element("span", { role: "columnheader" }, text));
    this.root = element(
      "div",
      { class: "registers" },
      element("p", {}, this.filter, " ", this.count),
      element("div", { class: "tree-row tree-head", role: "row" }, ...heads),
      this.view,
      this.detail,
    );
    this.stops = [
      context.connection.follow("registers", (values) => this.show(values)),
      context.connection.follow("layout", () => this.request()), // a reload may have moved, changed or removed registers
    ];
  }

  close() {
    for (const stop of this.stops) stop();
    clearInterval(this.timer);
    clearTimeout(this.typing);
    this.virtual.close();
    this.context.connection.call("registers.rows", { first: 0, count: 0 }).catch(() => {});
  }

  /** Request the rows again: the connection is new. Overrides of this page ended with the old one. */
  resume() {
    this.request();
  }

  restart() {
    this.view.scrollTop = 0;
    this.request();
  }

  /** Request the rows that are visible now, and whether the marked row is still in the table. */
  async request() {
    if (!this.root.isConnected) return; // the user has opened another tab
    const marked = this.marked?.path ?? "";
    const given = {
      ...this.virtual.wanted(),
      expanded: this.untouched ? null : [...this.expanded],
      filter: this.filter.value,
      marked,
    };
    const number = (this.asked += 1);
    try {
      const found = await this.context.connection.call("registers.rows", given);
      if (number < this.answered) return; // a later request was answered before
      this.answered = number;
      this.first = found.first;
      this.total = found.total;
      this.rows = found.rows;
      if (this.untouched) for (const row of this.rows) if (row.depth === 0) this.expanded.add(row.path);
      if (marked === (this.marked?.path ?? "")) this.marked = found.marked;
      this.draw();
    } catch (error) {
      if (this.context.connection.open) notify(String(/** @type {Error} */ (error).message), "problem");
    }
  }

  draw() {
    this.virtual.show(this.first, this.total, this.rows.map((row) => this.makeRow(row)));
    setText(this.count, this.total === 1 ? "1 row" : `${this.total} rows`);
    this.edit();
    this.fill();
  }

  /** @param {Row} row */
  makeRow(row) {
    const open = this.expanded.has(row.path);
    const mark = row.expandable ? (open ? "▾ " : "▸ ") : "";
    const name = element("span", { role: "gridcell", class: "name", title: row.path }, mark + row.name);
    name.style.paddingLeft = `${row.depth * 1.2}rem`;
    const cells = ["value", "quality", "origin", "age"].map((kind) => element("span", { role: "gridcell", class: kind }));
    const made = element(
      "div",
      { class: "tree-row", role: "row", "data-path": row.path, click: () => this.choose(row), "aria-level": row.depth + 1 },
      name,
      ...cells,
      element("span", { role: "gridcell", class: "dim" }, row.type),
      element("span", { role: "gridcell", class: "dim", title: row.comment }, row.comment),
    );
    if (row.expandable) made.setAttribute("aria-expanded", String(open));
    if (row.type !== undefined) {
      made.draggable = true;
      made.addEventListener("dragstart", (event) => event.dataTransfer?.setData("text/plain", row.path));
    }
    made.setAttribute("aria-selected", String(row.path === this.marked?.path));
    return made;
  }

  /** @param {Record<string, Value>} values */
  show(values) {
    this.values = values;
    this.valuesMs = performance.now();
    this.fill();
  }

  /** Write the values into the rows. */
  fill() {
    const passedS = (performance.now() - this.valuesMs) / 1000;
    this.rows.forEach((row, index) => {
      const value = this.values[row.path];
      const cells = this.body.children[index]?.children;
      if (value === undefined || cells === undefined) return;
      const [text, quality, reason, origin, age] = value;
      setText(cells[1], text === null ? "no value" : `${text}${row.unit ? ` ${row.unit}` : ""}`);
      setText(cells[2], reason ? `${quality}: ${reason}` : quality);
      cells[2].className = `quality ${quality}`;
      cells[2].setAttribute("title", reason);
      setText(cells[3], origin);
      cells[3].className = `origin ${origin}`;
      setText(cells[4], age === null ? "" : duration(age + passedS));
    });
    const [text, quality, , origin] = this.values[this.marked?.path ?? ""] ?? [];
    if (this.present) setText(this.present, quality === undefined ? "" : `${text ?? "no value"} (${quality}, ${origin})`);
  }

  /** Mark a row, and show the form for it. @param {Row | null} row */
  mark(row) {
    this.marked = row;
    this.draw();
    this.request();
  }

  /** Mark a row, and expand or collapse it. @param {Row} row */
  choose(row) {
    if (row.expandable) {
      this.untouched = false;
      if (!this.expanded.delete(row.path)) this.expanded.add(row.path);
      sessionStorage.setItem("expanded", JSON.stringify([...this.expanded].slice(-500)));
    }
    this.mark(row);
  }

  /** Show the form that writes the marked register; no form if none is marked. A value that the user types stays only with its register. */
  edit() {
    const { context } = this;
    const row = this.marked;
    const [mayWrite, injects] = [context.may("write"), context.may("inject")];
    const form = row?.type === undefined ? "" : JSON.stringify([row.path, row.type, row.writable, mayWrite, injects]);
    if (form === this.form) return;
    this.form = form;
    const typed = this.detail.querySelector("input")?.value ?? "";
    const before = this.detail.dataset.register;
    this.detail.onsubmit = null;
    this.present = null;
    if (row?.type === undefined) {
      delete this.detail.dataset.register;
      replace(this.detail);
      return;
    }
    const { path } = row;
    const value = element("input", { type: "text", "aria-label": "New value", placeholder: "5, 1.5, true, 16#FF, T#1s" });
    this.detail.dataset.register = `${path} ${row.type}`;
    if (before === this.detail.dataset.register) value.value = typed;
    this.present = element("span", { class: "dim" });
    const result = element("output", {});
    const act = async (/** @type {string} */ name, /** @type {object} */ given) => {
      setText(result, "…");
      const [text, kind] = await context.connection.call(`registers.${name}`, given).then(
        (done) => [done === null ? "lifted" : [done.outcome, done.reason].filter(Boolean).join(": "), "info"],
        (error) => [String(error.message), "problem"],
      );
      setText(result, text);
      if (!result.isConnected) notify(`${path}: ${text}`, /** @type {"info" | "problem"} */ (kind)); // another register is marked now
      this.request();
    };
    const writable = row.writable && mayWrite;
    const reason = row.writable ? "your roles do not allow you to write" : "the configuration's writable does not name this register";
    const write = element("button", { type: "submit", disabled: !writable, title: writable ? "Write to the device" : reason }, "Write");
    this.detail.onsubmit = () => writable && act("set", { path, value: value.value });
    replace(
      this.detail,
      element("strong", {}, path),
      this.present,
      value,
      write,
      element(
        "button",
        { type: "button", disabled: !injects, title: "Show this value to all consumers until you lift the override", click: () => act("override", { path, value: value.value }) },
        "Override",
      ),
      element("button", { type: "button", disabled: !injects, click: () => act("lift", { path }) }, "Lift"),
      element("button", { type: "button", click: () => plot(path) }, "Plot"),
      result,
    );
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    const at = this.rows.findIndex((row) => row.path === this.marked?.path);
    const row = this.rows[at];
    if (step !== undefined) {
      const next = at < 0 ? this.virtual.top() - this.first : at + step; // without a mark in view, it begins at the top
      this.mark(this.rows[Math.max(0, Math.min(this.rows.length - 1, next))] ?? null);
      this.body.querySelector("[aria-selected=true]")?.scrollIntoView({ block: "nearest" });
    } else if (row && (event.key === "Enter" || (row.expandable && (event.key === "ArrowRight") !== this.expanded.has(row.path) && event.key.startsWith("Arrow")))) {
      this.choose(row);
    } else return;
    event.preventDefault();
  }
}
