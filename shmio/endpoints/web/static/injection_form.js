// The form that writes an [[injection]] table of a campaign, with a preview of its condition.

import { element, replace, setText } from "./dom.js";
import { suggest } from "./suggest.js";

/** @typedef {import("./main.js").Context} Context */

/** The keys of each operation. @type {Record<string, string[]>} */
const OPERATIONS = {
  set: ["value"],
  offset: ["value"],
  scale: ["value"],
  clamp: ["min", "max"],
  noise: ["amplitude"],
  random: ["min", "max"],
  freeze: [],
  delay: ["delay_ms"],
  drop: [],
  flip: ["bits"],
};
/** Keys in words. @type {Record<string, string>} */
const WORDS = { value: "value", min: "least value", max: "greatest value", amplitude: "amplitude", delay_ms: "delay in ms", bits: "bits, such as 0, 3" };
const PREVIEW_MS = 500;
const NUMBER = /^-?(0|[1-9]\d*)(\.\d+)?(e[-+]?\d+)?$/i;

export class InjectionForm {
  /** @param {Context} context @param {(table: string) => void} add Takes a table as TOML. */
  constructor(context, add) {
    this.context = context;
    this.name = element("input", { type: "text", "aria-label": "Name of the injection", placeholder: "name", maxlength: 100, class: "short" });
    this.found = element("datalist", { id: "injection-paths" });
    this.target = element("input", { type: "search", "aria-label": "Register to inject", placeholder: "register, such as cell/Robot_800/Axs1_Pos", list: "injection-paths", maxlength: 200, input: () => suggest(context.connection, this.target, this.found) });
    this.operation = element(
      "select",
      { "aria-label": "Operation", change: () => this.fillKeys() },
      ...Object.keys(OPERATIONS).map((name) => element("option", {}, name)),
    );
    this.keys = element("span", { class: "bar" });
    this.when = element("input", { type: "text", "aria-label": "Condition", placeholder: "always, or a condition such as cell/Inputs/12 > 500", maxlength: 1000 });
    this.forS = element("input", { type: "number", "aria-label": "For how many seconds", min: 0, step: "any", class: "short" });
    this.preview = element("output", { class: "condition" });
    this.root = element(
      "form",
      { "aria-label": "New injection" },
      element("div", { class: "bar" }, this.target, this.found, this.operation, this.keys),
      element("div", { class: "bar" }, "when", this.when, "for", this.forS, "s, called", this.name, element("button", { type: "submit" }, "Add to the campaign")),
      this.preview,
    );
    this.root.addEventListener("submit", (event) => {
      event.preventDefault();
      add(this.table());
    });
    this.fillKeys();
    this.timer = setInterval(() => this.show(), PREVIEW_MS);
    this.asking = false;
  }

  close() {
    clearInterval(this.timer);
  }

  fillKeys() {
    const fields = OPERATIONS[this.operation.value].map((key) =>
      element("input", { type: "text", name: key, "aria-label": WORDS[key], placeholder: WORDS[key], class: "short" }),
    );
    replace(this.keys, ...fields);
  }

  /** Show whether the condition holds now. The server parses it. */
  async show() {
    const when = this.when.value.trim();
    if (when === "" || this.asking) {
      if (when === "") setText(this.preview, "");
      return;
    }
    this.asking = true;
    try {
      const { holds, values } = await this.context.connection.call("injections.condition", { when });
      const read = values.map((/** @type {[string, string | null]} */ [path, value]) => `${path} = ${value ?? "unknown"}`).join(", ");
      setText(this.preview, `The condition is ${holds === null ? "unknown" : holds ? "true" : "false"} now: ${read}`);
      this.preview.className = `condition ${holds ? "good" : "dim"}`;
    } catch (error) {
      setText(this.preview, String(/** @type {Error} */ (error).message));
      this.preview.className = "condition problem";
    } finally {
      this.asking = false;
    }
  }

  /** @returns {string} The table. What is wrong in it, the server says. */
  table() {
    const lines = ["[[injection]]", `name = ${JSON.stringify(this.name.value.trim() || "injection")}`];
    lines.push(`target = ${JSON.stringify(this.target.value.trim())}`, `operation = ${JSON.stringify(this.operation.value)}`);
    for (const field of this.keys.querySelectorAll("input")) {
      const text = field.value.trim();
      if (text !== "") lines.push(`${field.name} = ${field.name === "bits" ? `[${text}]` : value(text)}`);
    }
    const when = this.when.value.trim();
    if (when !== "") lines.push(`when = ${JSON.stringify(when)}`);
    if (this.forS.value !== "") lines.push(`for_s = ${this.forS.value}`);
    return `${lines.join("\n")}\n`;
  }
}

/** @param {string} text @returns {string} A value in TOML: a number, a boolean or a text. */
function value(text) {
  return NUMBER.test(text) || text === "true" || text === "false" ? text : JSON.stringify(text);
}
