// The cells tab: all cells of the fabric, with links to their pages.

import { element, setText } from "./dom.js";
import { duration } from "./format.js";
import { Table } from "./table.js";

/** @typedef {import("./main.js").Context} Context */
/**
 * @typedef {{ cell: string, state: string, host: string, instance: string, version: string, age_s: number,
 *   qualities: Record<string, number>, notes: string[], url: string, why: string }} Cell `qualities`: number of sources of each
 *   quality, the worst first. `why`: why there is no URL.
 * @typedef {{ problem: string, old_s: number | null, version: string, more: boolean, cells: Cell[] }} Found
 */

const HEADS = ["Cell", "State", "Host", "Instance", "Sources", "Version", "Age", "Page", "Note"];
/** The class of each state. Cells write their states themselves, so other texts come, too. */
const STATES = new Map([["running", "good"], ["degraded", "uncertain"], ["late", "uncertain"], ["down", "bad"], ["stopped", "dim"]]);

export class CellsTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    this.problem = element("p", { class: "problem", role: "status" });
    this.count = element("p", { class: "dim" }, "The server reads the cells …");
    this.table = new Table(HEADS, "cells");
    this.table.root.hidden = true;
    /** Links by cell. They stay, so that the keyboard's focus survives an update. @type {Map<string, HTMLAnchorElement>} */
    this.links = new Map();
    this.root = element("div", { class: "cells" }, this.problem, this.count, this.table.root);
    this.stop = context.connection.follow("cells", (data) => this.show(data));
  }

  close() {
    this.stop();
    this.context.connection.call("cells.leave").catch(() => {});
  }

  resume() {
    this.context.connection.call("cells.follow").catch(() => {});
  }

  /** @param {Found} found */
  show(found) {
    const { cells } = found;
    const old = found.problem && found.old_s !== null ? `. This list is ${duration(found.old_s)} old.` : "";
    setText(this.problem, found.problem + old);
    const all = found.more ? `The fabric has more cells; these are the first ${cells.length}.` : `${cells.length} ${cells.length === 1 ? "cell" : "cells"}`;
    setText(this.count, found.old_s === null ? "" : cells.length === 0 ? "The fabric has no cells yet." : all);
    this.table.root.hidden = cells.length === 0;
    const links = new Map(cells.filter(({ url }) => url).map(({ cell, url }) => [cell, this.link(cell, url)]));
    this.links = links;
    this.table.update(
      cells.map((one) => {
        const style = STATES.get(one.state) ?? "";
        const lost = one.state === "late" || one.state === "down";
        const [worst] = Object.keys(one.qualities);
        const sources = Object.entries(one.qualities).map(([quality, count]) => `${count} ${quality}`).join(", ");
        const present = !lost && one.state !== "stopped";
        const other = one.version !== found.version;
        return [
          one.cell,
          [one.state, style],
          one.host,
          one.instance,
          present ? [sources || "none", worst ?? "dim"] : [sources && `last: ${sources}`, "dim"],
          [one.version, other ? "uncertain" : "", other ? `this instance has ${found.version}` : ""],
          [duration(one.age_s), lost ? style : ""],
          links.get(one.cell) ?? [one.why, "dim"],
          one.notes.join("; "),
        ];
      }),
    );
  }

  /** @param {string} cell @param {string} url @returns {HTMLAnchorElement} */
  link(cell, url) {
    const link = this.links.get(cell) ?? element("a", { target: "_blank", rel: "noopener noreferrer", "aria-label": `Open the page of ${cell}` });
    if (link.getAttribute("href") !== url) link.setAttribute("href", url);
    setText(link, url);
    return link;
  }
}
