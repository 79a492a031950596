// Reads the history of registers from recordings, part by part.

import { Series, readBatch } from "./series.js";

/** @typedef {import("./connection.js").Connection} Connection */
/** @typedef {{ time_s: number, source: string, kind: string, by: string, text: string, paths: string[], more?: number, count?: number }} RecordedEvent */
/** @typedef {{ batches: string[], events: RecordedEvent[], share: number, reduced: boolean, damage: string[] }} Part */

/** The history of some registers in a window of time. It grows while it is read. */
export class SignalHistory {
  /** @param {string[]} paths In the order of the request. @param {number} from @param {number} to */
  constructor(paths, from, to) {
    this.paths = paths;
    this.from = from;
    this.to = to;
    this.share = 0;
    this.whole = false; // whether all of it is here
    this.series = new Map(paths.map((path) => [path, new Series()]));
    /** @type {string[]} Messages about places that could not be read. */
    this.damage = [];
    /** @type {import("./chart.js").Mark[]} */
    this.marks = [];
  }

  /** @param {number} from @param {number} to @returns {boolean} Whether it has this time, in a detail that is enough. */
  serves(from, to) {
    return this.from <= from && this.to >= to && this.to - this.from <= 4 * (to - from);
  }

  /** @param {Part} part */
  add(part) {
    for (const text of part.batches) {
      if (text === "") continue;
      const { number, times, columns } = readBatch(bytesOf(text), 1);
      const series = this.series.get(this.paths[number]);
      series?.append(series.last, times, columns[0].values, columns[0].marks, Infinity); // a gap has its own sample
    }
    if (part.reduced) for (const series of this.series.values()) series.reduced = true;
    this.marks.push(...part.events.map((event) => ({ time: event.time_s, text: textOf(event) })));
    this.damage.push(...part.damage);
    this.share = part.share;
  }

  /**
   * Read the history.
   *
   * @param {Connection} connection
   * @param {string} call The call that returns the next part.
   * @param {number} number The number of the work on the server.
   * @param {() => boolean} changed Called after each part; false ends the reading.
   */
  async read(connection, call, number, changed) {
    for (;;) {
      const part = await connection.call(call, { number });
      if (part === null) return;
      this.add(part);
      if (!changed()) return;
    }
  }
}

/** @param {string} text @returns {ArrayBuffer} */
function bytesOf(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
}

/** @param {RecordedEvent} event @returns {string} */
function textOf(event) {
  const paths = `${event.paths.join(", ")}${event.more ? ` and ${event.more} more` : ""}`;
  const others = event.count && event.count > 1 ? ` (and ${event.count - 1} more)` : "";
  return `${[event.kind, paths, event.text, event.by && `by ${event.by}`].filter(Boolean).join(" ")}${others}`;
}
