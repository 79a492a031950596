// Draws the series of one lane into a canvas. What is denser than the pixels is drawn as least and greatest value of each pixel.

import { INJECTED } from "./series.js";

/** @typedef {import("./series.js").Series} Series */
/** @typedef {{ series: Series, color: string, steps: boolean }} Line A line; `steps` for values that jump, such as BOOL. */
/** @typedef {{ time: number, text: string }} Mark An event: its time, and what happened. */
/** @typedef {{ from: number, to: number, cursor: number | null, mark: number | null, marks: Mark[] }} View Times in s, UTC. */

export const LEFT_PX = 70;
const BOTTOM_PX = 20;
const TOP_PX = 6;
const TICK_PX = 110;
const POINT_PX = 8; // samples that are farther apart are drawn as points, too
const DAY_S = 86_400;
const LABEL_PX = 60; // the text of an event is left out if it has less room
const MAX_LABEL_PX = 260;

/**
 * Draw a lane.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {number} width
 * @param {number} height
 * @param {Line[]} lines
 * @param {View} view
 */
export function draw(pen, width, height, lines, view) {
  const style = getComputedStyle(pen.canvas);
  const color = (/** @type {string} */ name) => style.getPropertyValue(name);
  const bottom = height - BOTTOM_PX;
  const [low, high] = bounds(lines, view);
  const x = (/** @type {number} */ time) => LEFT_PX + ((time - view.from) / (view.to - view.from)) * (width - LEFT_PX);
  const y = (/** @type {number} */ value) => bottom - ((value - low) / (high - low)) * (bottom - TOP_PX);
  pen.fillStyle = color("--back");
  pen.fillRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  pen.lineWidth = 1;
  pen.strokeStyle = color("--line");
  pen.fillStyle = color("--dim");
  pen.textBaseline = "middle";
  pen.textAlign = "right";
  for (const value of ticks(low, high, (bottom - TOP_PX) / 35)) {
    segment(pen, LEFT_PX, y(value), width, y(value));
    pen.fillText(label(value, high - low), LEFT_PX - 6, y(value));
  }
  pen.textAlign = "center";
  for (const time of ticks(view.from, view.to, (width - LEFT_PX) / TICK_PX)) {
    segment(pen, x(time), TOP_PX, x(time), bottom);
    pen.fillText(clock(time, view.to - view.from), x(time), height - BOTTOM_PX / 2);
  }
  pen.save();
  pen.beginPath();
  pen.rect(LEFT_PX, 0, width - LEFT_PX, bottom + 1);
  pen.clip();
  for (const { series } of lines) shade(pen, series, view, x, bottom, color("--injected"));
  for (const line of lines) trace(pen, line, view, x, y, width);
  drawMarks(pen, view, x, width, bottom, color);
  for (const [time, dash] of /** @type {[number | null, number[]][]} */ ([[view.mark, [4, 3]], [view.cursor, []]])) {
    if (time === null) continue;
    pen.setLineDash(dash);
    pen.strokeStyle = color("--text");
    segment(pen, x(time), 0, x(time), bottom);
  }
  pen.restore();
}

/** @param {Line[]} lines @param {View} view @returns {[number, number]} */
function bounds(lines, view) {
  let [low, high] = [Infinity, -Infinity];
  for (const { series } of lines) {
    const [least, greatest] = series.range(view.from, view.to);
    low = Math.min(low, least);
    high = Math.max(high, greatest);
  }
  if (low > high) return [0, 1];
  const margin = high > low ? 0.05 * (high - low) : Math.max(Math.abs(high) * 0.05, 0.5);
  return [low - margin, high + margin];
}

/**
 * Shade the times in which values are injected.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {Series} series
 * @param {View} view
 * @param {(time: number) => number} x
 * @param {number} bottom
 * @param {string} color
 */
function shade(pen, series, view, x, bottom, color) {
  pen.globalAlpha = 0.14;
  pen.fillStyle = color;
  const end = Math.min(series.count, series.at(view.to) + 1);
  let start = -1;
  for (let index = Math.max(0, series.at(view.from) - 1); index <= end; index += 1) {
    const injected = index < end && series.marks[index] === INJECTED;
    if (injected && start < 0) start = index;
    if (injected || start < 0) continue;
    const until = index < series.count ? series.times[index] : view.to;
    pen.fillRect(x(series.times[start]), 0, Math.max(1, x(until) - x(series.times[start])), bottom);
    start = -1;
  }
  pen.globalAlpha = 1;
}

/**
 * Draw the events: a triangle for each, and its text where there is room.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {View} view
 * @param {(time: number) => number} x
 * @param {number} width
 * @param {number} bottom
 * @param {(name: string) => string} color
 */
function drawMarks(pen, view, x, width, bottom, color) {
  const seen = view.marks.filter((mark) => mark.time >= view.from && mark.time <= view.to);
  pen.textAlign = "left";
  pen.setLineDash([2, 4]);
  let free = -Infinity;
  seen.forEach((mark, index) => {
    const at = x(mark.time);
    const next = index + 1 < seen.length ? x(seen[index + 1].time) : width;
    pen.fillStyle = pen.strokeStyle = color("--accent");
    pen.beginPath();
    pen.moveTo(at, bottom);
    pen.lineTo(at - 4, bottom - 7);
    pen.lineTo(at + 4, bottom - 7);
    pen.fill();
    if (at < free || next - at < LABEL_PX) return;
    pen.globalAlpha = 0.6;
    segment(pen, at, 0, at, bottom - 7);
    pen.globalAlpha = 1;
    const text = fitting(pen, mark.text, Math.min(next - at, MAX_LABEL_PX) - 8);
    const labelWidth = pen.measureText(text).width;
    free = at + labelWidth + 8;
    pen.fillStyle = color("--back");
    pen.fillRect(at + 3, 1, labelWidth + 4, 14);
    pen.fillStyle = color("--accent");
    pen.fillText(text, at + 5, 8);
  });
  pen.setLineDash([]);
}

/** @param {CanvasRenderingContext2D} pen @param {string} text @param {number} most @returns {string} The text, cut to a width. */
function fitting(pen, text, most) {
  if (pen.measureText(text).width <= most) return text;
  let length = text.length;
  while (length > 1 && pen.measureText(`${text.slice(0, length)}…`).width > most) length -= Math.ceil(length / 8);
  return `${text.slice(0, length)}…`;
}

/**
 * Draw a line.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {Line} line
 * @param {View} view
 * @param {(time: number) => number} x
 * @param {(value: number) => number} y
 * @param {number} width
 */
function trace(pen, line, view, x, y, width) {
  const { series } = line;
  const first = Math.max(0, series.at(view.from) - 1);
  const end = Math.min(series.count, series.at(view.to) + 1);
  pen.strokeStyle = line.color;
  pen.lineWidth = 1.5;
  pen.beginPath();
  if (end - first > 3 * width) traceDense(pen, series, first, end, x, y);
  else {
    let drawing = false;
    let before = 0;
    for (let index = first; index < end; index += 1) {
      const value = series.values[index];
      if (!Number.isFinite(value)) {
        drawing = false;
        continue;
      }
      const [atX, atY] = [x(series.times[index]), y(value)];
      if (!drawing) pen.moveTo(atX, atY);
      else {
        if (line.steps) pen.lineTo(atX, before);
        pen.lineTo(atX, atY);
      }
      before = atY;
      drawing = true;
    }
  }
  pen.stroke();
  if ((end - first) * POINT_PX > width) return;
  pen.fillStyle = line.color;
  for (let index = first; index < end; index += 1) {
    if (Number.isFinite(series.values[index])) pen.fillRect(x(series.times[index]) - 2, y(series.values[index]) - 2, 4, 4);
  }
}

/**
 * Add to the path, for each pixel, a line from its least to its greatest value.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {Series} series
 * @param {number} first
 * @param {number} end
 * @param {(time: number) => number} x
 * @param {(value: number) => number} y
 */
function traceDense(pen, series, first, end, x, y) {
  let pixel = NaN;
  let [least, greatest, last] = [Infinity, -Infinity, NaN];
  const flush = () => {
    if (least > greatest) return;
    if (Number.isNaN(last)) pen.moveTo(pixel, y(least));
    else pen.lineTo(pixel, y(least));
    pen.lineTo(pixel, y(greatest));
  };
  for (let index = first; index < end; index += 1) {
    const at = Math.round(x(series.times[index]));
    if (at !== pixel) {
      flush();
      if (least <= greatest) last = greatest;
      [pixel, least, greatest] = [at, Infinity, -Infinity];
    }
    const value = series.values[index];
    if (Number.isFinite(value)) {
      least = Math.min(least, value);
      greatest = Math.max(greatest, value);
    } else {
      flush();
      [least, greatest, last] = [Infinity, -Infinity, NaN];
    }
  }
  flush();
}

/** @param {CanvasRenderingContext2D} pen @param {number} x1 @param {number} y1 @param {number} x2 @param {number} y2 */
function segment(pen, x1, y1, x2, y2) {
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x2, y2);
  pen.stroke();
}

/** @param {number} low @param {number} high @param {number} count @returns {number[]} Round numbers in between. */
export function ticks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((factor) => factor * power >= rough) ?? 10);
  const found = [];
  for (let number = Math.ceil(low / step); number * step <= high && found.length < 100; number += 1) found.push(number * step);
  return found;
}

/** @param {number} value @param {number} span @returns {string} */
function label(value, span) {
  const digits = Math.max(0, 2 - Math.floor(Math.log10(span)));
  return Math.abs(value) >= 1e6 || digits > 6 ? value.toPrecision(5) : value.toFixed(Math.min(digits, 6));
}

/** @param {number} time @param {number} span @returns {string} A time of day where the user is. */
export function clock(time, span = 0) {
  const date = new Date(1000 * time);
  const text = date.toLocaleTimeString("en-GB");
  if (span > DAY_S) return `${date.toLocaleDateString("en-CA").slice(5)} ${text.slice(0, 5)}`;
  return span < 10 ? `${text}.${String(date.getMilliseconds()).padStart(3, "0")}` : text;
}
