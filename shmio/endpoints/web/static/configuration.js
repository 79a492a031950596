// The configuration tab: the file with its faults, what a reload would do, and the reload.

import { element, notify, replace, setText } from "./dom.js";
import { UploadedFiles } from "./uploads.js";

/** @typedef {import("./main.js").Context} Context */
/** @typedef {{ kind: string, line: number, text: string }} Message */
/** @typedef {{ stop: string[], start: string[], restart: string[], change: string[], injections: string[], reread: string[], keep: string[] }} Changes */
/**
 * @typedef {{ file: string, version: string, lines: string[], problem: string, messages: Message[], changes: Changes | null,
 *   read_s: number | null }} Configuration
 */

/** @type {[keyof Changes, string, string, string][]} Kind, sign, class, text. */
const KINDS = [
  ["stop", "−", "bad", "stop"],
  ["start", "+", "good", "start"],
  ["restart", "±", "uncertain", "restart"],
  ["change", "±", "uncertain", "keep the connection of"],
  ["injections", "±", "injected", "change"],
  ["reread", "±", "uncertain", "reload the tokens and roles of"],
];

export class ConfigurationTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    /** @type {Configuration | null} */
    this.found = null;
    const controls = context.may("control");
    this.place = element("p", { class: "dim" });
    this.file = element("ol", { class: "file", "aria-label": "Configuration file", tabindex: 0 });
    this.others = element("ul", { class: "messages", "aria-label": "Other messages" });
    this.changes = element("div", { class: "changes", "aria-live": "polite" }, "The supervisor checks the file …");
    this.button = element(
      "button",
      { type: "button", disabled: true, title: controls ? null : "your roles do not allow you to reload", click: () => this.ask() },
      "Reload …",
    );
    this.result = element("ul", { class: "messages", role: "status" });
    this.uploads = new UploadedFiles();
    const plan = element(
      "section",
      { class: "plan", "aria-label": "Reload" },
      element("div", { class: "bar" }, element("h2", {}, "A reload would"), element("span", { class: "grow" }), element("button", { type: "button", click: () => this.check() }, "Check again"), this.button),
      this.changes,
      this.result,
    );
    this.root = element(
      "div",
      { class: "configuration" },
      element("div", { class: "columns" }, element("section", {}, this.place, this.others, this.file), plan),
      this.uploads.root,
    );
    this.uploads.accept(this.root);
    this.stop = context.connection.follow("configuration", (data) => this.show(data));
  }

  close() {
    this.stop();
    this.uploads.close();
    this.context.connection.call("configuration.leave").catch(() => {});
  }

  resume() {
    this.context.connection.call("configuration.follow").catch(() => {});
  }

  /** @param {Configuration} found */
  show(found) {
    this.found = found;
    const since = found.read_s === null ? "" : `; the instance read it on ${new Date(found.read_s * 1000).toLocaleString("en-GB")}`;
    setText(this.place, `${found.file}${since}. Secrets are masked.`);
    /** @type {Map<number, Message[]>} */
    const byLine = new Map();
    for (const message of found.messages) byLine.set(message.line, [...(byLine.get(message.line) ?? []), message]);
    const lines = found.lines.map((text, index) =>
      element("li", { "data-line": index + 1 }, element("code", {}, text || " "), ...(byLine.get(index + 1) ?? []).map(shown)),
    );
    const elsewhere = found.messages.filter(({ line }) => line < 1 || line > found.lines.length);
    replace(this.file, ...lines);
    replace(this.others, ...elsewhere.map((message) => element("li", {}, shown(message))));
    replace(this.changes, ...this.describe(found));
    this.button.disabled = !this.context.may("control") || found.changes === null;
    this.file.querySelector(".message")?.scrollIntoView({ block: "nearest" });
  }

  /** @param {Configuration} found @returns {HTMLElement[]} */
  describe({ problem, changes, messages }) {
    if (problem) return [element("p", { class: "problem" }, problem)];
    if (changes === null) {
      const count = messages.filter(({ kind }) => kind === "fault").length;
      return [element("p", { class: "bad" }, `be refused: the file has ${count === 1 ? "a fault" : `${count} faults`}. Nothing would change.`)];
    }
    return listed(changes);
  }

  /** Check the file again, now. */
  async check() {
    try {
      this.show(await this.context.connection.call("configuration.check"));
    } catch (error) {
      notify(String(/** @type {Error} */ (error).message), "problem");
    }
  }

  /** Show what a reload would do now, and do it if the user confirms. */
  async ask() {
    this.button.disabled = true;
    await this.check();
    const { found } = this;
    if (found === null || found.changes === null) return;
    const { stop, restart } = found.changes;
    const own = restart.some((line) => line.startsWith("web:"))
      ? "The server of this page is one of them: the page connects again by itself."
      : stop.includes("web")
        ? "The file has no [web] section: this page ends."
        : "";
    const confirm = element("button", { type: "submit", value: "reload" }, "Reload");
    const dialog = element(
      "dialog",
      { "aria-label": "Reload the configuration", class: "wide" },
      element(
        "form",
        { method: "dialog" },
        element("h2", {}, "A reload will"),
        element("div", { class: "changes" }, ...listed(found.changes)),
        own ? element("p", { class: "uncertain" }, own) : null,
        element("div", { class: "bar" }, confirm, element("button", { type: "submit", value: "" }, "Cancel")),
      ),
    );
    dialog.addEventListener("close", () => {
      dialog.remove();
      if (dialog.returnValue === "reload") this.reload(found.version);
    });
    document.body.append(dialog);
    dialog.showModal();
  }

  /** @param {string} version */
  async reload(version) {
    replace(this.result, element("li", {}, "The supervisor reloads …"));
    try {
      const { done, problems, kept } = await this.context.connection.call("configuration.reload", { version });
      const lines = [...done.map((/** @type {string} */ text) => [text, "good"]), ...problems.map((/** @type {string} */ text) => [text, "bad"])];
      replace(this.result, ...[...lines, [`${kept.length} processes were kept`, "dim"]].map(([text, kind]) => element("li", { class: kind }, text)));
      this.check();
    } catch (error) {
      replace(this.result, element("li", { class: "problem" }, String(/** @type {Error} */ (error).message)));
    }
  }
}

/** @param {Message} message */
function shown({ kind, text }) {
  return element("span", { class: `message ${kind === "fault" ? "bad" : "uncertain"}` }, `${kind}: ${text}`);
}

/** @param {Changes} changes @returns {HTMLElement[]} */
function listed(changes) {
  const lines = KINDS.flatMap(([kind, sign, style, verb]) =>
    changes[kind].map((line) => {
      const [name, ...reasons] = kind === "restart" ? line.split(": ") : [line];
      const why = reasons.join(": ");
      return element("li", {}, element("span", { class: style }, `${sign} ${verb} ${name}`), why ? element("ul", {}, ...why.split("; ").map((one) => element("li", {}, one))) : null);
    }),
  );
  if (lines.length === 0) return [element("p", { class: "good" }, "change nothing: the instance runs as the file says.")];
  const kept = changes.keep.length;
  return [element("ul", { class: "diff" }, ...lines), element("p", { class: "dim" }, `and keep ${kept === 1 ? changes.keep[0] : `${kept} processes`} as ${kept === 1 ? "it is" : "they are"}.`)];
}
