// The injections tab: what is injected now, campaigns, and the events of all sources.

import { clock } from "./chart.js";
import { element, notify, replace, setText } from "./dom.js";
import { InjectionForm } from "./injection_form.js";

/** @typedef {import("./main.js").Context} Context */
/**
 * @typedef {{ source: string, number: string, name: string, direction: string, priority: number, keep: boolean, by: string,
 *   state: string, since_s: number | null, utc_s: number | null, seed: string | null, operation?: string, when?: string | null,
 *   registers: string[], count: number }} Injection
 */
/**
 * @typedef {{ time_s: number, source: string, kind: string, by: string, cycle: number, text: string, paths: string[],
 *   more: number, missed: number }} SourceEvent
 */

const HEADS = ["Number", "Name", "Registers", "What", "State", "By", ""];
const EVENT_HEADS = ["Time", "Source", "Event", "By", "Registers", "Text"];
const KEY = "campaign";
const EXAMPLE = `# docs/reference/injections.md has all keys
[[injection]]
name = "drift"
target = "cell/Robot_800/Axs1_Pos"
operation = "offset"
value = 0.5
for_s = 10
`;

export class InjectionsTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    const injects = context.may("inject");
    const why = injects ? null : "your roles do not allow you to inject";
    /** @type {SourceEvent[]} */
    this.events = [];
    this.body = element("tbody", {}, element("tr", {}, element("td", { class: "dim" }, "none")));
    this.eventBody = element("tbody");
    this.lift = element("button", { type: "button", class: "danger", disabled: !injects, title: why, click: () => this.liftAll() }, "Lift all injections");
    this.text = element("textarea", { rows: 10, spellcheck: "false", "aria-label": "Campaign", maxlength: 60_000 });
    this.text.value = sessionStorage.getItem(KEY) ?? EXAMPLE;
    this.text.addEventListener("input", () => {
      sessionStorage.setItem(KEY, this.text.value);
      replace(this.result); // it was about another text
    });
    this.keep = element("input", { type: "checkbox" });
    this.result = element("output", { class: "preview" });
    this.file = element("input", { type: "file", accept: ".toml", "aria-label": "Campaign file", change: () => this.load() });
    this.filter = element("input", { type: "search", placeholder: "Filter events", "aria-label": "Filter events", input: () => this.fillEvents() });
    const form = element(
      "form",
      { class: "campaign", "aria-label": "Campaign" },
      this.text,
      element(
        "div",
        { class: "bar" },
        this.file,
        element("button", { type: "button", click: () => this.check() }, "Check"),
        element("button", { type: "submit", disabled: !injects, title: why }, "Start"),
        element("label", {}, this.keep, " keep it when this page is closed"),
      ),
      this.result,
    );
    this.form = new InjectionForm(context, (one) => this.add(one));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.start();
    });
    this.root = element(
      "div",
      {},
      element("div", { class: "bar" }, element("h2", {}, "Present injections"), element("span", { class: "grow" }), this.lift),
      table("injections", HEADS, this.body),
      element("h2", {}, "New injection"),
      this.form.root,
      element("h2", {}, "Campaign"),
      form,
      element("div", { class: "bar" }, element("h2", {}, "Events"), this.filter),
      table("events", EVENT_HEADS, this.eventBody),
    );
    this.stops = [
      context.connection.follow("injections", (data) => this.fill(data)),
      context.connection.follow("events", (data) => {
        this.events = data;
        this.fillEvents();
      }),
    ];
  }

  close() {
    for (const stop of this.stops) stop();
    this.form.close();
    this.context.connection.call("injections.leave").catch(() => {});
  }

  resume() {
    this.context.connection.call("injections.follow").catch(() => {});
  }

  /** @param {Injection[]} injections */
  fill(injections) {
    const rows = injections.map((one) => {
      const more = one.count > one.registers.length ? ` and ${one.count - one.registers.length} more` : "";
      const what = one.operation ? `${one.operation}${one.when ? ` when ${one.when}` : ""}` : "values of a program";
      const since = one.state === "active" && one.since_s !== null ? ` since ${one.utc_s === null ? `${one.since_s.toFixed(3)} s of virtual time` : clock(one.utc_s)}` : "";
      const lift = element(
        "button",
        { type: "button", disabled: !this.context.may("inject"), click: () => this.act("lift", { source: one.source, number: one.number }) },
        "Lift",
      );
      return row(
        one.number,
        one.name,
        element("span", { title: one.registers.join("\n") }, `${one.registers.slice(0, 3).join(", ")}${one.registers.length > 3 ? ", …" : ""}${more} /${one.direction}`),
        what,
        element("span", { class: one.state === "active" ? "injected" : "dim" }, `${one.state}${since}`),
        `${one.by}${one.keep ? ", kept" : ""}`,
        lift,
      );
    });
    replace(this.body, ...(rows.length ? rows : [row(element("span", { class: "dim" }, "none"))]));
  }

  fillEvents() {
    const wanted = this.filter.value.toLowerCase();
    const rows = [];
    for (const event of [...this.events].reverse()) {
      const paths = `${event.paths.join(", ")}${event.more ? ` and ${event.more} more` : ""}`;
      const cells = [clock(event.time_s), event.source, event.kind, event.by, paths, event.text];
      if (event.missed) cells[5] += ` (${event.missed} events before it were lost)`;
      if (cells.join(" ").toLowerCase().includes(wanted)) rows.push(row(...cells));
    }
    replace(this.eventBody, ...rows);
  }

  /** @param {string} table Add it to the campaign; it replaces the example. */
  add(table) {
    const before = this.text.value === EXAMPLE ? "" : this.text.value.trim();
    this.text.value = before === "" ? table : `${before}\n\n${table}`;
    sessionStorage.setItem(KEY, this.text.value);
    this.check();
  }

  async load() {
    const file = this.file.files?.[0];
    if (!file) return;
    if (file.size > 60_000) {
      notify("This file is larger than 60 kB.", "problem");
      return;
    }
    this.text.value = await file.text();
    sessionStorage.setItem(KEY, this.text.value);
    this.file.value = "";
    this.check();
  }

  async check() {
    const text = this.text.value;
    const found = await this.act("check", { text });
    if (found === null || text !== this.text.value) return;
    const lines = found.map((/** @type {any} */ one) => {
      const more = one.count > one.registers.length ? ` and ${one.count - one.registers.length} more` : "";
      return element("li", {}, `${one.name}: ${one.operation}${one.when ? ` when ${one.when}` : ""}, over ${one.registers.join(", ")}${more}`);
    });
    replace(this.result, "No faults. It injects:", element("ul", {}, ...lines));
  }

  async start() {
    const found = await this.act("start", { text: this.text.value, keep: this.keep.checked });
    if (found === null) return;
    const lines = found.map((/** @type {any} */ one) => element("li", {}, `${one.name}: number ${one.number}, seed ${one.seed}`));
    replace(this.result, "Started:", element("ul", {}, ...lines));
  }

  async liftAll() {
    const count = await this.act("lift_all", {});
    if (count !== null) notify(count === 1 ? "1 injection is lifted" : `${count} injections are lifted`);
  }

  /**
   * Make a call; show why it failed.
   *
   * @param {string} name
   * @param {object} given
   * @returns {Promise<any>} null if it failed.
   */
  async act(name, given) {
    setText(this.result, "");
    try {
      return (await this.context.connection.call(`injections.${name}`, given)) ?? true;
    } catch (error) {
      const text = String(/** @type {Error} */ (error).message);
      if (name === "check" || name === "start") setText(this.result, text);
      else notify(text, "problem");
      return null;
    }
  }
}

/** @param {string} name @param {string[]} heads @param {HTMLElement} body */
function table(name, heads, body) {
  const head = element("tr", {}, ...heads.map((text) => element("th", { scope: "col" }, text)));
  return element("table", { "aria-label": name }, element("thead", {}, head), body);
}

/** @param {...(Node | string | number)} cells */
function row(...cells) {
  return element("tr", {}, ...cells.map((cell) => element("td", {}, cell)));
}
