// The time tab: steps, plays, pauses and releases the time of the instance.

import { element, notify, setText } from "./dom.js";

/** @typedef {import("./main.js").Context} Context */
/**
 * @typedef {{ mode: string, time_s: number, step: number, step_size_ms: number, playing: boolean, rate: number, stepping: boolean,
 *   owner: number, note: string }} Clock
 */

const REFRESH_MS = 500;

export class TimeTab {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    const controls = context.may("control");
    const why = controls ? null : "your roles do not allow you to control time";
    this.mode = element("dd");
    this.time = element("dd");
    this.step = element("dd");
    this.playing = element("dd");
    this.owner = element("dd");
    this.note = element("dd");
    this.real = element("p", { class: "dim" });
    this.count = element("input", { type: "number", min: 1, max: 10_000, value: 1, "aria-label": "Number of steps" });
    this.length = element("input", { type: "number", min: 0.001, max: 3_600_000, step: "any", placeholder: "step size", "aria-label": "Length of a step in ms" });
    this.rate = element("input", { type: "number", min: 0.001, max: 1000, step: "any", value: 1, "aria-label": "Rate" });
    const button = (/** @type {string} */ text, /** @type {string} */ name, /** @type {() => object} */ given) =>
      element("button", { type: "button", disabled: !controls, title: why, click: () => this.act(name, given()) }, text);
    this.buttons = [
      button("Step", "step", () => ({ count: Number(this.count.value), dt_s: this.dt() })),
      button("Run", "play", () => ({ rate: Number(this.rate.value), dt_s: this.dt() })),
      button("Pause", "pause", () => ({})),
      button("Back to real time", "release", () => ({})),
    ];
    const [step, run, pause, release] = this.buttons;
    this.root = element(
      "div",
      { class: "time" },
      element("h2", {}, "Clock"),
      element(
        "dl",
        {},
        ...[
          ["Mode", this.mode],
          ["Time", this.time],
          ["Step", this.step],
          ["Runs", this.playing],
          ["Owner", this.owner],
          ["Note", this.note],
        ].flatMap(([name, value]) => [element("dt", {}, name), value]),
      ),
      element("h2", {}, "Control"),
      element("p", { class: "bar" }, step, this.count, " steps of ", this.length, " ms"),
      element("p", { class: "bar" }, run, " at ", this.rate, " times real time", pause),
      element("p", { class: "bar" }, release),
      element("p", { class: "dim" }, "The first of these takes control of time: from then on, only steps move it, until you return to real time."),
      this.real,
    );
    this.timer = setInterval(() => this.resume(), REFRESH_MS);
  }

  close() {
    clearInterval(this.timer);
  }

  async resume() {
    try {
      const state = await this.context.connection.call("time.state");
      this.show(state.clock);
      const names = state.real_sources.join(", ");
      setText(this.real, names ? `Steps do not affect these sources, which have a device: ${names}.` : "");
    } catch {
      // the connection is lost: the head line says so
    }
  }

  /** @returns {number | null} The length of a step in s. */
  dt() {
    return this.length.value === "" ? null : Number(this.length.value) / 1000;
  }

  /** @param {Clock} clock */
  show(clock) {
    const virtual = clock.mode === "virtual";
    setText(this.mode, virtual ? "virtual: only steps move time" : "real time");
    setText(this.time, `${clock.time_s.toFixed(3)} s`);
    setText(this.step, virtual ? `${clock.step}${clock.stepping ? " under way" : ""}; step size ${clock.step_size_ms} ms` : "");
    setText(this.playing, virtual ? (clock.playing ? `yes, at ${clock.rate} times real time` : "no") : "");
    const owner = this.context.overview?.processes.find((/** @type {any} */ one) => one.pid === clock.owner)?.name;
    setText(this.owner, clock.owner ? (owner ?? `process ${clock.owner}`) : "");
    setText(this.note, clock.note);
  }

  /** @param {string} name @param {object} given */
  async act(name, given) {
    try {
      this.show(await this.context.connection.call(`time.${name}`, given));
    } catch (error) {
      notify(String(/** @type {Error} */ (error).message), "problem");
    }
  }
}
