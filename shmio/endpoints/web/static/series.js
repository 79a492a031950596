// The samples of one register over time.

/** Provenances as the server numbers them. */
export const INJECTED = 3;

const FIRST_SIZE = 1024;
const HEAD_BYTES = 16;

/**
 * Read a batch of samples: see shmio/endpoints/web/signals.py.
 *
 * @param {ArrayBuffer} batch
 * @param {number} registers Number of registers in it.
 * @returns {{ number: number, before: number, times: Float64Array, columns: { values: Float64Array, marks: Uint8Array }[] }}
 */
export function readBatch(batch, registers) {
  const view = new DataView(batch);
  const rows = view.getUint32(4, true);
  const marksAt = HEAD_BYTES + 8 * rows * (1 + registers);
  const columns = Array.from({ length: registers }, (_, index) => ({
    values: new Float64Array(batch, HEAD_BYTES + 8 * rows * (1 + index), rows),
    marks: new Uint8Array(batch, marksAt + rows * index, rows),
  }));
  return { number: batchNumber(batch), before: view.getFloat64(8, true), times: new Float64Array(batch, HEAD_BYTES, rows), columns };
}

/** @param {ArrayBuffer} batch @returns {number} The number of its feed. */
export function batchNumber(batch) {
  return new DataView(batch).getUint32(0, true);
}

/** Samples in the order of time. A NaN is a gap. */
export class Series {
  constructor() {
    this.count = 0;
    this.reduced = false; // whether samples were left out that a plot does not need
    this.times = new Float64Array(FIRST_SIZE);
    this.values = new Float64Array(FIRST_SIZE);
    this.marks = new Uint8Array(FIRST_SIZE);
  }

  /** Time of the last sample in s, UTC; NaN if there is none. */
  get last() {
    return this.count ? this.times[this.count - 1] : NaN;
  }

  /**
   * Append the samples of a batch.
   *
   * @param {number} before Time of the frame before them; another time than that of the last sample makes a gap.
   * @param {Float64Array} times
   * @param {Float64Array} values
   * @param {Uint8Array} marks Their provenance.
   * @param {number} most Number of samples that are kept. Older ones are dropped.
   */
  append(before, times, values, marks, most) {
    while (this.count && this.last >= times[0]) this.count -= 1; // sent again, after the connection was lost
    const gap = this.count > 0 && before !== this.last ? 1 : 0;
    this.reserve(gap + times.length, most);
    if (gap) {
      this.times[this.count] = times[0];
      this.values[this.count] = NaN;
      this.marks[this.count] = 0;
      this.count += 1;
    }
    this.times.set(times, this.count);
    this.values.set(values, this.count);
    this.marks.set(marks, this.count);
    this.count += times.length;
  }

  /** @param {number} more @param {number} most */
  reserve(more, most) {
    if (this.count + more > most) {
      const drop = Math.min(this.count, Math.max(this.count + more - most, Math.floor(most / 4)));
      for (const column of [this.times, this.values, this.marks]) column.copyWithin(0, drop, this.count);
      this.count -= drop;
    }
    let size = this.times.length;
    while (size < this.count + more) size *= 2;
    if (size === this.times.length) return;
    const [times, values, marks] = [this.times, this.values, this.marks];
    this.times = new Float64Array(size);
    this.values = new Float64Array(size);
    this.marks = new Uint8Array(size);
    this.times.set(times);
    this.values.set(values);
    this.marks.set(marks);
  }

  /**
   * Return the index of the first sample at or after a time.
   *
   * @param {number} time
   * @returns {number}
   */
  at(time) {
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /**
   * Return the value that was present at a time: that of the last sample until then.
   *
   * @param {number} time
   * @returns {number} NaN in a gap, and before the first sample.
   */
  valueAt(time) {
    const index = this.at(time);
    if (index < this.count && this.times[index] === time) return this.values[index];
    return index > 0 ? this.values[index - 1] : NaN;
  }

  /**
   * Return the least and the greatest value between two times.
   *
   * @param {number} from
   * @param {number} to
   * @returns {[number, number]} Infinity and -Infinity if there is no value.
   */
  range(from, to) {
    let least = Infinity;
    let greatest = -Infinity;
    const end = Math.min(this.count, this.at(to) + 1);
    for (let index = Math.max(0, this.at(from) - 1); index < end; index += 1) {
      const value = this.values[index];
      if (value < least && value !== -Infinity) least = value;
      if (value > greatest && value !== Infinity) greatest = value;
    }
    return [least, greatest];
  }
}
