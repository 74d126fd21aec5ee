// The canvas that shows the shadow and the painting.

import { Pinch } from "./pinch.js";

// A finger paints once it has moved so far, in pixels of the window, or stayed so long. A second finger may come until then.
const HELD_PIXELS = 6, HELD_MS = 90;

export class Painting {
  // onStroke(id, mode, radius, points): a part of a stroke, [x, y, x, y, ...] in pixels of the shadow.
  constructor(canvas, brush, zoom, onStroke) {
    this.canvas = canvas;
    this.brush = brush;
    this.zoom = zoom;
    this.onStroke = onStroke;
    this.mode = "add";
    this.radius = 12;
    this.size = [0, 0];
    this.cursor = null; // [x, y], pixels
    this.stroke = null; // {id, mode, pointer, points: not sent yet}
    this.held = null; // a finger that does not paint yet: {event, mode, timer}
    this.pinch = new Pinch();
    this.pinching = false; // until all fingers are up
    this.panning = false;
    this.strokes = 0;
    this.mostPoints = 2;
    this.#listen();
  }

  open(width, height, mostPoints) {
    this.canvas.width = width;
    this.canvas.height = height;
    this.size = [width, height];
    this.mostPoints = mostPoints;
    this.shadow = new Uint8Array(width * height).fill(255);
    this.target = this.shadow.slice();
    this.context = this.canvas.getContext("2d");
    this.image = this.context.createImageData(width, height);
    this.drop();
  }

  // Paper, ink, missing and excess: [red, green, blue] each.
  setColours(colours) {
    this.colours = colours;
  }

  // Ends the stroke without sending the rest of it.
  drop() {
    this.stroke = null;
    this.#release();
  }

  // Paints all pixels, and returns how well they match: intersection over union of the two shadows.
  draw() {
    const { shadow, target, image: { data }, colours: { paper, ink, missing: lacking, excess: surplus } } = this;
    let both = 0, either = 0;
    for (let i = 0, o = 0; i < shadow.length; i++, o += 4) {
      const dark = 255 - shadow[i], wanted = 255 - target[i];
      const common = Math.min(dark, wanted) / 255, missing = Math.max(wanted - dark, 0) / 255, excess = Math.max(dark - wanted, 0) / 255;
      const light = 1 - common - missing - excess;
      for (let c = 0; c < 3; c++) data[o + c] = light * paper[c] + common * ink[c] + missing * lacking[c] + excess * surplus[c];
      data[o + 3] = 255;
      both += dark > 127 && wanted > 127;
      either += dark > 127 || wanted > 127;
    }
    this.context.putImageData(this.image, 0, 0);
    return either ? both / either : 1;
  }

  setMode(mode) {
    this.mode = mode;
  }

  setRadius(radius) {
    this.radius = radius;
    this.#showBrush();
  }

  // Sends the part of the stroke that has been painted since the last call.
  flush() {
    const { stroke } = this;
    if (!stroke || !stroke.points.length) return;
    const { id, mode, radius, points } = stroke;
    for (let i = 0; i < points.length; i += 2 * this.mostPoints - 2) {
      this.onStroke(id, mode, radius, points.slice(i, i + 2 * this.mostPoints));
      if (i + 2 * this.mostPoints >= points.length) break;
    }
    stroke.last = points.slice(-2);
    stroke.points = [];
  }

  #listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, (event) => this.#up(event));
    // Otherwise the middle button scrolls.
    canvas.addEventListener("mousedown", (event) => event.button === 1 && event.preventDefault());
    canvas.addEventListener("pointerleave", () => {
      if (!this.stroke) this.brush.hidden = true;
    });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4] }[event.key];
      if (step) {
        const [x, y] = this.cursor ?? this.size.map((s) => s / 2);
        const clip = (v, most) => Math.min(Math.max(v, 0), most);
        this.#move([clip(x + step[0], this.size[0]), clip(y + step[1], this.size[1])]);
        this.zoom.reveal(this.cursor.map((v, axis) => v / this.size[axis]));
      } else if (event.key === " ") {
        if (!this.stroke) this.#begin(this.cursor ?? this.size.map((s) => s / 2), event.shiftKey ? "erase" : this.mode);
      } else return;
      event.preventDefault();
    });
    canvas.addEventListener("keyup", (event) => event.key === " " && this.#end());
    canvas.addEventListener("blur", () => this.#end());
  }

  #place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [((event.clientX - box.left) / box.width) * this.size[0], ((event.clientY - box.top) / box.height) * this.size[1]];
  }

  #down(event) {
    const { canvas, pinch } = this;
    const erase = event.shiftKey || event.button === 5; // 5: a pen's eraser
    const mode = erase ? "erase" : this.mode;
    if (event.button > 1 && event.button !== 5) return;
    canvas.setPointerCapture(event.pointerId);
    if (event.button === 1) {
      this.panning = true;
    } else if (event.pointerType === "touch") {
      pinch.down(event);
      if (pinch.fingers === 1) {
        this.held = { event, mode, timer: setTimeout(() => this.#take(), HELD_MS) };
      } else {
        // Two fingers move the view. A stroke that has been seen stays.
        this.pinching = true;
        this.#release();
        this.#end();
        this.brush.hidden = true;
      }
    } else {
      this.#begin(this.#place(event), mode, event.pointerId);
    }
  }

  #drag(event) {
    if (this.panning) {
      this.zoom.move(event.movementX, event.movementY);
      return;
    }
    const change = this.pinch.move(event);
    if (this.pinching) {
      if (!change) return;
      this.zoom.by(change.factor, change.x, change.y);
      this.zoom.move(change.dx, change.dy);
      return;
    }
    if (this.held) {
      const { clientX, clientY } = this.held.event;
      if (Math.hypot(event.clientX - clientX, event.clientY - clientY) < HELD_PIXELS) return;
      this.#take();
    }
    // Another pointer does not continue a stroke.
    if (this.stroke && this.stroke.pointer !== event.pointerId) return;
    const events = event.getCoalescedEvents?.() ?? [];
    for (const part of events.length ? events : [event]) this.#move(this.#place(part));
  }

  #up(event) {
    this.pinch.up(event);
    if (this.pinching) {
      this.pinching = this.pinch.fingers > 0;
    } else if (this.panning) {
      this.panning = false;
    } else {
      if (event.type === "pointerup") this.#take();
      this.#release();
      this.#end();
    }
  }

  // Lets the finger that was held begin its stroke.
  #take() {
    const { held } = this;
    this.#release();
    if (held) this.#begin(this.#place(held.event), held.mode, held.event.pointerId);
  }

  #release() {
    clearTimeout(this.held?.timer);
    this.held = null;
  }

  #begin(point, mode, pointer = null) {
    this.#end();
    this.stroke = { id: ++this.strokes, mode, pointer, radius: this.radius, points: [...point], last: null };
    this.#cover(point, point);
    this.#move(point);
    this.flush(); // the first dot at once, the rest of the stroke once a frame
  }

  #move(point) {
    const from = this.cursor;
    this.cursor = point;
    this.#showBrush();
    const { stroke } = this;
    if (!stroke || (from && stroke.last && from[0] === point[0] && from[1] === point[1])) return;
    const limit = 2 * Math.max(...this.size);
    if (point.some((v) => Math.abs(v) > limit)) return;
    // Each part begins where the one before has ended.
    if (!stroke.points.length && stroke.last) stroke.points.push(...stroke.last);
    const [x, y] = stroke.points.slice(-2);
    stroke.points.push(...point);
    this.#cover([x, y], point);
    this.canvas.dispatchEvent(new Event("painted"));
  }

  #end() {
    this.flush();
    this.stroke = null;
  }

  // Paints the target as the server will, so that the user need not wait for the answer.
  #cover([x0, y0], [x1, y1]) {
    const [width, height] = this.size, { radius, mode } = this.stroke;
    const dx = x1 - x0, dy = y1 - y0, length = dx * dx + dy * dy;
    const bounds = (a, b, most) => [Math.max(Math.floor(Math.min(a, b) - radius - 1), 0), Math.min(Math.max(a, b) + radius + 1, most)];
    const [left, right] = bounds(x0, x1, width), [top, bottom] = bounds(y0, y1, height);
    for (let y = top; y < bottom; y++) {
      for (let x = left; x < right; x++) {
        const px = x + 0.5 - x0, py = y + 0.5 - y0;
        const t = length > 0 ? Math.min(Math.max((px * dx + py * dy) / length, 0), 1) : 0;
        const cover = Math.min(Math.max(radius + 0.5 - Math.hypot(px - t * dx, py - t * dy), 0), 1) * 255;
        const i = y * width + x;
        this.target[i] = mode === "add" ? Math.min(this.target[i], 255 - cover) : Math.max(this.target[i], cover);
      }
    }
  }

  #showBrush() {
    const { brush, cursor } = this;
    if (!cursor) return;
    const scale = 100 / this.size[0];
    brush.hidden = false;
    brush.style.left = `${cursor[0] * scale}%`;
    brush.style.top = `${(cursor[1] * 100) / this.size[1]}%`;
    brush.style.width = brush.style.height = `${2 * this.radius * scale}%`;
  }
}
