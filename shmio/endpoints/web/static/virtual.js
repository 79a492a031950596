// The geometry of a table with so many rows that only the visible ones exist.

import { element, replace } from "./dom.js";

const ROW_PX = 26;
const SPARE_ROWS = 10;
const MAX_ROWS = 200;
// Browsers cannot make elements of any height. Beyond this, each pixel of the scroll bar stands for several rows.
const MAX_HEIGHT_PX = 8_000_000;

export class VirtualRows {
  /**
   * @param {Record<string, string | number>} attributes Those of the scrolling element, `root`.
   * @param {() => void} request Called when other rows may be visible.
   */
  constructor(attributes, request) {
    this.total = 0;
    this.body = element("div", { class: "tree-rows", role: "rowgroup" });
    this.space = element("div", { class: "tree-space" }, this.body);
    this.root = element("div", { class: "tree", tabindex: 0, ...attributes, scroll: request }, this.space);
    this.resize = new ResizeObserver(request);
    this.resize.observe(this.root);
  }

  close() {
    this.resize.disconnect();
  }

  /** Return which rows to show: the visible ones, and a few around them. */
  wanted() {
    const fit = Math.ceil(this.root.clientHeight / ROW_PX);
    return { first: Math.max(0, this.top() - SPARE_ROWS), count: Math.min(MAX_ROWS, fit + 2 * SPARE_ROWS) };
  }

  /**
   * Show rows.
   *
   * @param {number} first Number of the first of these rows.
   * @param {number} total Number of all rows.
   * @param {HTMLElement[]} rows
   */
  show(first, total, rows) {
    this.total = total;
    const height = Math.min(total * ROW_PX, MAX_HEIGHT_PX);
    this.space.style.height = `${height}px`;
    const top = height < MAX_HEIGHT_PX ? first * ROW_PX : this.root.scrollTop - (this.top() - first) * ROW_PX;
    this.body.style.transform = `translateY(${top}px)`;
    replace(this.body, ...rows);
  }

  /** Return the number of the topmost visible row. */
  top() {
    const height = Math.min(this.total * ROW_PX, MAX_HEIGHT_PX);
    return height === 0 ? 0 : Math.floor((this.root.scrollTop / height) * this.total);
  }
}
