// The registers of files that the user drops: sources of data blocks, tag tables, other tools' tag lists.

import { element, replace, setText } from "./dom.js";
import { VirtualRows } from "./virtual.js";

/** @typedef {[string, string, string, number, string, string, string]} Row Path, type, place, size, initial value, unit, comment. */
/** @typedef {{ name: string, number: number | null, size: number, count: number, registers: Row[] }} Layout */

const MAX_MB = 8;
const HEADS = ["Register", "Type", "Place", "Bytes", "Initial value", "Comment"];
const HINT = "Drop a .db source here to see its registers, with the files of its UDTs; or a tag table, or another tool's tag list.";

/** A place to drop files, and their registers. The server compiles them and keeps nothing. */
export class UploadedFiles {
  constructor() {
    /** @type {Row[]} */
    this.rows = [];
    /** @type {Row[]} */
    this.matching = [];
    this.files = element("input", { type: "file", multiple: true, "aria-label": "Files", change: () => this.read([...(this.files.files ?? [])]) });
    this.filter = element("input", { type: "search", placeholder: "Search path or comment", "aria-label": "Search registers", maxlength: 200, input: () => this.search() });
    this.count = element("span", { class: "dim" });
    this.state = element("p", { role: "status" }, HINT);
    this.messages = element("ul", { class: "messages" });
    this.virtual = new VirtualRows({ role: "table", "aria-label": "Registers of the files" }, () => this.draw());
    const heads = HEADS.map((text) => element("span", { role: "columnheader" }, text));
    this.table = element(
      "div",
      { class: "dropped-table", hidden: true },
      element("div", { class: "bar" }, this.filter, this.count),
      element("div", { class: "tree-row tree-head", role: "row" }, ...heads),
      this.virtual.root,
    );
    this.root = element(
      "section",
      { class: "drop", "aria-label": "Registers of a file" },
      element("div", { class: "bar" }, element("h2", {}, "Registers of a file"), this.files),
      this.state,
      this.messages,
      this.table,
    );
  }

  /** @param {HTMLElement} place Where files can be dropped. */
  accept(place) {
    place.addEventListener("dragover", (event) => {
      event.preventDefault();
      this.root.classList.add("over");
    });
    place.addEventListener("dragleave", () => this.root.classList.remove("over"));
    place.addEventListener("drop", (event) => {
      event.preventDefault();
      this.root.classList.remove("over");
      this.read([...(event.dataTransfer?.files ?? [])]);
    });
  }

  close() {
    this.virtual.close();
  }

  /** @param {File[]} files */
  async read(files) {
    if (files.length === 0) return;
    this.show([], []);
    const names = files.map((file) => file.name).join(", ");
    if (files.reduce((sum, file) => sum + file.size, 0) > MAX_MB * 2 ** 20) {
      setText(this.state, `${names}: more than ${MAX_MB} MB; use shmio-layout for such files`);
      return;
    }
    setText(this.state, `Reading ${names} …`);
    const head = JSON.stringify(files.map(({ name, size }) => ({ name, size })));
    try {
      const answer = await fetch("layout", { method: "POST", body: new Blob([`${head}\n`, ...files]) });
      const found = await answer.json();
      if (!answer.ok) throw new Error(found.error);
      this.show(found.layouts, found.messages);
      setText(this.state, found.layouts.length ? found.layouts.map(title).join("; ") : `${names}: no registers`);
    } catch (error) {
      setText(this.state, `${names}: ${String(/** @type {Error} */ (error).message)}`);
    }
    this.files.value = "";
  }

  /** @param {Layout[]} layouts @param {string[]} messages */
  show(layouts, messages) {
    const several = layouts.length > 1;
    this.rows = layouts.flatMap(({ name, registers }) =>
      several ? registers.map((row) => /** @type {Row} */ ([`${name}: ${row[0]}`, ...row.slice(1)])) : registers,
    );
    const lines = messages.map((text) => element("li", { class: text.includes(": error: ") ? "bad" : text.startsWith("imported") ? "dim" : "uncertain" }, text));
    replace(this.messages, ...lines);
    this.table.hidden = layouts.length === 0;
    this.filter.value = "";
    this.search();
  }

  search() {
    const wanted = this.filter.value.toLowerCase();
    this.matching = this.rows.filter((row) => row[0].toLowerCase().includes(wanted) || row[6].toLowerCase().includes(wanted));
    setText(this.count, `${this.matching.length} rows`);
    this.virtual.root.scrollTop = 0;
    this.virtual.total = this.matching.length;
    this.draw();
  }

  draw() {
    const { first, count } = this.virtual.wanted();
    const rows = this.matching.slice(first, first + count).map(([path, type, place, size, initial, unit, comment]) => {
      const cells = [path, type, place, String(size), [initial, unit].filter(Boolean).join(" "), comment];
      return element("div", { class: "tree-row", role: "row" }, ...cells.map((text) => element("span", { role: "cell", title: text }, text)));
    });
    this.virtual.show(first, this.matching.length, rows);
  }
}

/** @param {Layout} layout */
function title({ name, number, size, count, registers }) {
  const of = registers.length < count ? `, of which ${registers.length} are shown` : "";
  return `${name}${number === null ? "" : ` (DB${number})`}: ${count} registers${of}, ${size} bytes`;
}
