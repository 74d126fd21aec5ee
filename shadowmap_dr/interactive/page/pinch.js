// Two fingers on an element: how they move, turn apart and come together.

export class Pinch {
  #points = new Map(); // pointer id -> [x, y], pixels of the window

  // Number of fingers that are down.
  get fingers() {
    return this.#points.size;
  }

  down({ pointerId, clientX, clientY }) {
    this.#points.set(pointerId, [clientX, clientY]);
  }

  up({ pointerId }) {
    this.#points.delete(pointerId);
  }

  // The change since the last event of a finger: {factor, dx, dy}, about the middle (x, y); null without two fingers.
  move({ pointerId, clientX, clientY }) {
    if (!this.#points.has(pointerId)) return null;
    const before = this.#frame();
    this.#points.set(pointerId, [clientX, clientY]);
    const after = this.#frame();
    if (!before || !after) return null;
    return { factor: after.length / before.length, dx: after.x - before.x, dy: after.y - before.y, x: after.x, y: after.y };
  }

  #frame() {
    const [a, b] = this.#points.values();
    if (!b) return null;
    return { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, length: Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1) };
  }
}
