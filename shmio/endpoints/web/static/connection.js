// The WebSocket to the server: calls with answers, and data that comes unasked.

/** @typedef {{ id: number, result?: any, error?: string } & { topic?: string, data?: any }} Message */

const FIRST_DELAY_MS = 250;
const LAST_DELAY_MS = 5000;
// A server that is asleep or out of reach closes nothing. The overview comes each second, so silence means that it is lost.
const SILENCE_MS = 10000;

/**
 * A connection that opens itself again whenever it is lost.
 *
 * It has the events "open" and "lost". After each "open", everything that the page follows must be requested again.
 */
export class Connection extends EventTarget {
  constructor() {
    super();
    /** @type {WebSocket | null} */
    this.socket = null;
    this.open = false;
    this.delayMs = FIRST_DELAY_MS;
    this.last = 0;
    this.receivedAt = 0;
    /** @type {Map<number, { done: (result: any) => void, failed: (error: Error) => void }>} */
    this.calls = new Map();
    /** @type {Map<string, Set<(data: any) => void>>} */
    this.followers = new Map();
    /** @type {(batch: ArrayBuffer) => void} */
    this.onBatch = () => {};
    setInterval(() => this.checkSilence(), 2000);
  }

  /** Connect now. A present connection is closed first. */
  connect() {
    this.lose();
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.receivedAt = Date.now();
    socket.onopen = () => {
      this.open = true;
      this.delayMs = FIRST_DELAY_MS;
      this.dispatchEvent(new Event("open"));
    };
    socket.onmessage = (event) => {
      this.receivedAt = Date.now();
      if (event.data instanceof ArrayBuffer) this.onBatch(event.data);
      else this.receive(JSON.parse(event.data));
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.lose();
      setTimeout(() => this.socket === null && this.connect(), this.delayMs);
      this.delayMs = Math.min(2 * this.delayMs, LAST_DELAY_MS);
    };
  }

  /** Close the connection and do not open it again. */
  close() {
    this.lose();
  }

  /**
   * Make a call.
   *
   * @param {string} name
   * @param {object} [given] Its arguments.
   * @returns {Promise<any>} The result; rejected with the server's message.
   */
  call(name, given = {}) {
    return new Promise((done, failed) => {
      if (!this.open || this.socket === null) {
        failed(new Error("there is no connection to the server"));
        return;
      }
      this.last += 1;
      this.calls.set(this.last, { done, failed });
      this.socket.send(JSON.stringify({ id: this.last, call: name, with: given }));
    });
  }

  /**
   * Receive the data of a topic.
   *
   * @param {string} topic
   * @param {(data: any) => void} take
   * @returns {() => void} Function that ends it.
   */
  follow(topic, take) {
    const takers = this.followers.get(topic) ?? new Set();
    this.followers.set(topic, takers.add(take));
    return () => takers.delete(take);
  }

  /** @param {Message} message */
  receive(message) {
    if (message.topic !== undefined) {
      for (const take of this.followers.get(message.topic) ?? []) take(message.data);
      return;
    }
    const call = this.calls.get(message.id);
    this.calls.delete(message.id);
    if (message.error !== undefined) call?.failed(new Error(message.error));
    else call?.done(message.result);
  }

  lose() {
    const { socket, open } = this;
    this.socket = null;
    this.open = false;
    socket?.close();
    for (const { failed } of this.calls.values()) failed(new Error("the connection to the server was lost: outcome unknown"));
    this.calls.clear();
    if (open) this.dispatchEvent(new Event("lost"));
  }

  checkSilence() {
    if (this.socket !== null && Date.now() - this.receivedAt > SILENCE_MS) this.connect();
  }
}
