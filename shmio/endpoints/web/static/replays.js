// The replays of the instance: where each is, and its control.

import { clock } from "./chart.js";
import { element, notify, replace, setText } from "./dom.js";

/** @typedef {import("./main.js").Context} Context */
/**
 * @typedef {{ source: string, time_s: number, position_s: number, length_s: number, speed: number, paused: boolean, loop: boolean,
 *   over: boolean, until_s: number | null }} Playing
 */

const REFRESH_MS = 400;
const MOVE_MS = 200; // the least time between two moves of a slider that is dragged

export class ReplayPanel {
  /** @param {Context} context */
  constructor(context) {
    this.context = context;
    this.root = element("div", { hidden: true });
    /** @type {Map<string, Replay>} The replay of each recording. */
    this.replays = new Map();
    this.timer = setInterval(() => this.refresh(), REFRESH_MS);
  }

  close() {
    clearInterval(this.timer);
  }

  async refresh() {
    if (this.context.overview !== null && !this.context.overview.processes.length) return;
    try {
      const { replays, kinds } = await this.context.connection.call("recordings.replays");
      this.show(replays, kinds);
    } catch {
      // the connection is lost: the head line says so
    }
  }

  /** @param {Playing[]} playing @param {string[]} kinds */
  show(playing, kinds) {
    /** @type {Map<string, Playing[]>} The sources of one recording move together. */
    let groups = new Map();
    for (const one of playing) {
      const key = `${(one.time_s - one.position_s).toFixed(3)} ${one.length_s}`;
      groups.set(key, [...(groups.get(key) ?? []), one]);
    }
    // A reload may add a source to a recording's replay: the controls move the sources that their heading names.
    groups = new Map([...groups.values()].map((some) => [some.map((one) => one.source).join(", "), some]));
    const known = [...this.replays.keys()];
    if (known.length !== groups.size || known.some((key) => !groups.has(key))) {
      this.replays = new Map([...groups].map(([key, some]) => [key, new Replay(this.context, some, kinds)]));
      replace(this.root, element("h2", {}, "Replay"), ...[...this.replays.values()].map((replay) => replay.root));
    }
    for (const [key, some] of groups) this.replays.get(key)?.show(some[0]);
    this.root.hidden = groups.size === 0;
  }
}

class Replay {
  /** @param {Context} context @param {Playing[]} playing @param {string[]} kinds */
  constructor(context, playing, kinds) {
    this.context = context;
    this.sources = playing.map((one) => one.source);
    this.paused = true;
    this.dragging = false;
    /** @type {number | null} The position to which to move next. */
    this.wanted = null;
    this.moving = false;
    const controls = context.may("control");
    const why = controls ? null : "your roles do not allow you to control replays";
    const lock = { disabled: !controls, title: why };
    this.play = element("button", { type: "button", ...lock, click: () => this.change({ paused: !this.paused }) }, "Play");
    this.slider = element("input", { type: "range", min: 0, max: playing[0].length_s, step: "any", "aria-label": "Position", ...lock });
    this.slider.addEventListener("input", () => this.move(Number(this.slider.value)));
    this.slider.addEventListener("pointerdown", () => (this.dragging = true));
    this.slider.addEventListener("change", () => (this.dragging = false));
    this.position = element("span", { class: "value", "aria-label": "Present position" });
    this.speed = element("input", { class: "short", type: "number", min: 0.01, max: 1000, step: "any", "aria-label": "Speed", ...lock });
    this.speed.addEventListener("change", () => this.change({ speed: Number(this.speed.value) }));
    this.loop = element("input", { type: "checkbox", ...lock });
    this.loop.addEventListener("change", () => this.change({ loop: this.loop.checked }));
    this.jump = element("input", { type: "checkbox", ...lock });
    this.register = element("input", { type: "search", placeholder: "Register", "aria-label": "Register of the next change", maxlength: 1000, ...lock });
    this.kind = element("select", { "aria-label": "Kind of event", ...lock }, ...kinds.map((kind) => element("option", {}, kind)));
    this.state = element("span", { role: "status", class: "dim" });
    const toChange = element("form", { class: "bar" }, this.register, element("button", { type: "submit", ...lock }, "To its next change"));
    toChange.addEventListener("submit", (event) => {
      event.preventDefault();
      if (this.register.value) this.change({ change: this.register.value.trim(), jump: this.jump.checked }, "searching…");
    });
    const toEvent = () => this.change({ event: this.kind.value, jump: this.jump.checked }, "searching…");
    this.root = element(
      "section",
      { class: "replay", "aria-label": `Replay of ${this.sources.join(", ")}` },
      element("div", { class: "bar" }, element("strong", {}, this.sources.join(", ")), this.play, this.position, this.state),
      this.slider,
      element("div", { class: "bar" }, "Speed ", this.speed, element("label", {}, this.loop, " start again at the end")),
      element(
        "div",
        { class: "bar" },
        toChange,
        this.kind,
        element("button", { type: "button", ...lock, click: toEvent }, "To the next event"),
        element("label", {}, this.jump, " jump there instead of playing"),
      ),
    );
  }

  /** @param {Playing} playing */
  show(playing) {
    this.paused = playing.paused || playing.over;
    setText(this.play, this.paused ? "Play" : "Pause");
    const until = playing.until_s === null ? "" : `, pauses at ${playing.until_s.toFixed(3)} s`;
    const state = playing.over ? "at its end" : playing.paused ? "paused" : "playing";
    setText(this.position, `${state}: ${playing.position_s.toFixed(3)} s of ${playing.length_s.toFixed(3)} s (${clock(playing.time_s, 1)})${until}`);
    if (!this.dragging && this.wanted === null) this.slider.value = String(playing.position_s);
    if (document.activeElement !== this.speed) this.speed.value = String(playing.speed);
    this.loop.checked = playing.loop;
  }

  /** Move to a position; while a move is under way, only the newest one is kept. @param {number} position_s */
  async move(position_s) {
    this.wanted = position_s;
    if (this.moving) return;
    this.moving = true;
    while (this.wanted !== null) {
      /** @type {number} */
      const next = this.wanted;
      await this.change({ seek: String(next) });
      await new Promise((done) => setTimeout(done, MOVE_MS));
      if (this.wanted === next) this.wanted = null;
    }
    this.moving = false;
  }

  /** @param {object} given @param {string} meanwhile What to show until the answer comes. */
  async change(given, meanwhile = "") {
    setText(this.state, meanwhile);
    try {
      const found = await this.context.connection.call("recordings.replay", { sources: this.sources, ...given });
      const own = found.find((/** @type {Playing} */ one) => this.sources.includes(one.source));
      if (own !== undefined) this.show(own);
    } catch (error) {
      notify(String(/** @type {Error} */ (error).message), "problem");
    }
    setText(this.state, "");
  }
}
