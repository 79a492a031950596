// Follows registers frame by frame: the batches of shmio/endpoints/web/signals.py.

import { notify } from "./dom.js";
import { Series, batchNumber, readBatch } from "./series.js";

/** @typedef {import("./connection.js").Connection} Connection */
/** @typedef {import("./lanes.js").Signal} Signal */
/** @typedef {{ number: number, period_ms: number, signals: Signal[] }} Feed */

const RETRY_MS = 3000;
const MAX_SERIES = 600_000;

/** The registers that a tab follows, with their samples. A page has one of these at a time. */
export class Feeds {
  /**
   * @param {Connection} connection
   * @param {() => string[]} wanted Returns the paths that are followed, with their source.
   * @param {() => void} changed Called when there are new samples.
   * @param {number} most Number of samples that are kept of all registers.
   */
  constructor(connection, wanted, changed, most) {
    this.connection = connection;
    this.wanted = wanted;
    this.changed = changed;
    this.most = most;
    /** @type {Map<string, Series>} */
    this.series = new Map();
    /** @type {Map<string, Signal>} */
    this.signals = new Map();
    /** @type {Map<string, Feed>} */
    this.bySource = new Map();
    /** @type {Map<number, Feed>} */
    this.byNumber = new Map();
    this.lagS = Infinity; // of this computer's clock against the server's times
    connection.onBatch = (batch) => this.take(batch);
    this.stop = connection.follow("plots", (numbers) => this.lost(numbers));
  }

  close() {
    this.stop();
    clearTimeout(this.retry);
    this.connection.onBatch = () => {};
    for (const source of this.bySource.keys()) this.connection.call("plots.follow", { source, paths: [] }).catch(() => {});
  }

  /** Follow all registers again: the connection is new. */
  resume() {
    this.bySource.clear();
    this.byNumber.clear();
    this.lagS = Infinity;
    this.followAll();
  }

  async followAll() {
    clearTimeout(this.retry);
    const sources = new Set(this.wanted().map(sourceOf));
    for (const source of sources) if (!this.bySource.has(source)) await this.follow(source);
  }

  /**
   * Follow the registers of a source that are wanted now.
   *
   * @param {string} source
   * @returns {Promise<boolean>} False if the server refused it.
   */
  async follow(source) {
    const paths = this.wanted().filter((path) => sourceOf(path) === source);
    try {
      const feed = await this.connection.call("plots.follow", { source, paths });
      const old = this.bySource.get(source);
      if (old !== undefined && old.number !== feed?.number) this.byNumber.delete(old.number);
      this.bySource.delete(source);
      if (feed === null) return true;
      this.bySource.set(source, feed);
      this.byNumber.set(feed.number, feed);
      for (const signal of feed.signals) this.signals.set(signal.path, signal);
      return true;
    } catch (error) {
      if (!this.connection.open) return true;
      notify(String(/** @type {Error} */ (error).message), "problem");
      this.retry = setTimeout(() => this.followAll(), RETRY_MS);
      return false;
    }
  }

  /** Follow the sources again whose feeds have ended. @param {number[]} numbers The feeds that are left. */
  lost(numbers) {
    for (const [source, feed] of this.bySource) {
      if (numbers.includes(feed.number)) continue;
      this.bySource.delete(source);
      this.byNumber.delete(feed.number);
    }
    this.followAll();
  }

  /** @param {ArrayBuffer} batch */
  take(batch) {
    const feed = this.byNumber.get(batchNumber(batch));
    if (feed === undefined) return;
    const { before, times, columns } = readBatch(batch, feed.signals.length);
    const most = Math.min(MAX_SERIES, Math.floor(this.most / feed.signals.length));
    feed.signals.forEach(({ path }, index) => {
      let series = this.series.get(path);
      if (series === undefined) this.series.set(path, (series = new Series()));
      series.append(before, times, columns[index].values, columns[index].marks, most);
    });
    this.lagS = Math.min(this.lagS, Date.now() / 1000 - times[times.length - 1]);
    this.changed();
  }
}

/** @param {string} path @returns {string} */
export function sourceOf(path) {
  return path.split("/")[0];
}
