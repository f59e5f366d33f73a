// The connection: asks for one turn at a time, and connects again by itself.

export const PROTOCOL = "skinware.view.2";
const FIRST_WAIT_MS = 300;
const LONGEST_WAIT_MS = 4000;
const SILENCE_MS = 3000; // the server answers within 0.5 s, also without news

export class Link {
  #socket = null;
  #wait_ms = FIRST_WAIT_MS;
  #timer = 0;
  #silence = 0;

  /**
   * @param {string} url of the web socket.
   * @param {object} handlers `turn(message)`, `open()`, `lost(reason, wait_ms)`.
   */
  constructor(url, handlers) {
    this.url = url;
    this.handlers = handlers;
  }

  get isOpen() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  connect() {
    clearTimeout(this.#timer);
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    socket.onopen = () => {
      this.#wait_ms = FIRST_WAIT_MS;
      this.handlers.open();
      this.next();
    };
    socket.onmessage = ({ data }) => {
      if (socket !== this.#socket) return;
      clearTimeout(this.#silence);
      this.handlers.turn(data);
    };
    socket.onclose = ({ reason }) => socket === this.#socket && this.#lost(reason);
    this.#listen(socket); // an answer to the connection itself may never come
  }

  /** Ask for the next turn; there is one request at a time. */
  next() {
    if (!this.isOpen) return;
    this.send({ op: "next", protocol: PROTOCOL });
    this.#listen(this.#socket);
  }

  /** Ask for something; what is asked while there is no connection is dropped. */
  send(op) {
    if (this.isOpen) this.#socket.send(JSON.stringify(op));
  }

  #listen(socket) {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => {
      socket.onclose = null; // closing takes long without an answer
      socket.close();
      this.#lost("no answer");
    }, SILENCE_MS);
  }

  #lost(reason) {
    clearTimeout(this.#silence);
    this.#socket = null;
    this.handlers.lost(reason, this.#wait_ms);
    this.#timer = setTimeout(() => this.connect(), this.#wait_ms);
    this.#wait_ms = Math.min(2 * this.#wait_ms, LONGEST_WAIT_MS);
  }
}
