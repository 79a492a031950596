// Tables that are updated again and again.

import { element, replace, setText } from "./dom.js";

/** A table whose rows are named by their first cell. */
export class Table {
  /** @param {string[]} heads @param {string} name */
  constructor(heads, name) {
    this.body = element("tbody");
    this.heads = heads.map((text) => element("th", { scope: "col" }, text));
    const head = element("tr", {}, ...this.heads);
    this.root = element("div", { class: "wide" }, element("table", { "aria-label": name, id: name }, element("thead", {}, head), this.body));
  }

  /** @param {(string | number | [string, string, string?] | HTMLElement)[][]} rows An array is a text, its class, and its tooltip. */
  update(rows) {
    while (this.body.rows.length > rows.length) this.body.deleteRow(-1);
    rows.forEach((cells, index) => {
      const row = this.body.rows[index] ?? this.body.insertRow();
      cells.forEach((cell, column) => {
        const target = row.cells[column] ?? row.insertCell();
        if (cell instanceof HTMLElement) {
          if (target.firstChild !== cell) replace(target, cell);
          target.className = "";
          return;
        }
        const [text, style, more = ""] = Array.isArray(cell) ? cell : [String(cell), typeof cell === "number" ? "number" : ""];
        setText(target, text);
        if (target.title !== more) target.title = more;
        if (index === 0) this.heads[column].className = style === "number" ? "number" : "";
        if (target.className !== style) target.className = style;
      });
    });
    if (rows.length === 0) replace(this.body, element("tr", {}, element("td", { class: "dim" }, "none")));
  }
}
