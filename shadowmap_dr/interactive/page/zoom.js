// The part of a sheet that its board shows. The sheet grows beyond the board, which cuts it off.

const MOST = 8, STEP = 1.25;
// The sheet shows its pixels as squares once they are so wide on the screen.
const SQUARES = 8;

export class Zoom {
  // onChange(scale)
  constructor(board, sheet, onChange) {
    this.board = board;
    this.sheet = sheet;
    this.onChange = onChange;
    this.scale = 1;
    this.corner = [0, 0]; // of the sheet, in widths and heights of the board
    board.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    new ResizeObserver(() => this.#show()).observe(board);
  }

  // Multiplies the scale. The point (x, y) of the window stays where it is; without one, the board's middle.
  by(factor, x, y) {
    const at = this.#place(x, y);
    const scale = Math.min(Math.max(this.scale * factor, 1), MOST);
    this.corner = this.corner.map((corner, axis) => at[axis] - ((at[axis] - corner) * scale) / this.scale);
    this.scale = scale;
    this.#show();
  }

  step(direction, x, y) {
    this.by(STEP ** direction, x, y);
  }

  // Moves the sheet by pixels of the window.
  move(dx, dy) {
    const { width, height } = this.board.getBoundingClientRect();
    this.corner = [this.corner[0] + dx / width, this.corner[1] + dy / height];
    this.#show();
  }

  reset() {
    this.scale = 1;
    this.#show();
  }

  // Moves the sheet so that a point of it, (0..1, 0..1), is seen.
  reveal(point) {
    const margin = 0.05;
    this.corner = this.corner.map((corner, axis) => {
      const at = corner + point[axis] * this.scale;
      return corner + Math.min(Math.max(at, margin), 1 - margin) - at;
    });
    this.#show();
  }

  #wheel(event) {
    event.preventDefault();
    const unit = event.deltaMode === 0 ? 1 : 16;
    if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
      this.move(-event.deltaX * unit, 0);
      return;
    }
    // A pinch on a touchpad comes as a wheel with Ctrl, in small steps.
    const rate = event.ctrlKey ? 0.01 : 0.003, delta = Math.min(Math.max(event.deltaY * unit, -75), 75);
    this.by(Math.exp(-rate * delta), event.clientX, event.clientY);
  }

  #place(x, y) {
    if (x === undefined) return [0.5, 0.5];
    const { left, top, width, height } = this.board.getBoundingClientRect();
    return [(x - left) / width, (y - top) / height];
  }

  #show() {
    const { scale, sheet: { style } } = this;
    this.corner = this.corner.map((corner) => Math.min(Math.max(corner, 1 - scale), 0));
    style.width = style.height = `${100 * scale}%`;
    style.left = `${100 * this.corner[0]}%`;
    style.top = `${100 * this.corner[1]}%`;
    const canvas = this.sheet.querySelector("canvas");
    this.sheet.classList.toggle("squares", this.board.clientWidth * scale >= SQUARES * canvas.width);
    this.onChange(scale);
  }
}
