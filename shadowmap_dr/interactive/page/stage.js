// The object in front of the wall with its shadow. Draws only when something has changed.

import { Pinch } from "./pinch.js";
import * as THREE from "./three.module.min.js";

const FIELD = Math.tan((16 * Math.PI) / 180); // half of the image, at distance 1, along its shorter side
const START = { turn: 0.62, rise: 0.24, distance: 11.5 };

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    const software = isSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !software });
    // Drawing without a graphics card is slow.
    this.mostRatio = software ? 1 : 2;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.1, 100);
    this.view = { ...START };
    this.planned = false;
    new ResizeObserver(() => this.plan()).observe(canvas);
    this.#listen();
  }

  // Paper, ink, stage and clay: [red, green, blue] each.
  setColours({ paper, ink, stage, clay }) {
    this.scene.background = colour(stage);
    this.clay = colour(clay);
    this.mesh?.material.color.copy(this.clay);
    this.tones = new Uint32Array(256).map((_, tone) => {
      const [r, g, b] = paper.map((light, c) => Math.round(ink[c] + ((light - ink[c]) * tone) / 255));
      return ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
    });
    if (this.texture) this.#project();
    this.plan();
  }

  // The hello message: the receiver's place, and the size of its image.
  open({ width, height, half, right, up, forward, origin }) {
    this.scene.clear();
    this.axes = [right, up, forward].map((v) => new THREE.Vector3(...v));
    this.middle = new THREE.Vector3(...origin).multiplyScalar(0.45);
    const wall = new THREE.PlaneGeometry(2 * half, 2 * half);
    const uv = wall.attributes.uv;
    for (let i = 0; i < uv.count; i++) uv.setY(i, 1 - uv.getY(i)); // images begin at the top
    this.texture = new THREE.DataTexture(new Uint8Array(4 * width * height).fill(255), width, height);
    this.texture.colorSpace = THREE.SRGBColorSpace;
    this.texture.magFilter = this.texture.minFilter = THREE.LinearFilter;
    const receiver = new THREE.Mesh(wall, new THREE.MeshBasicMaterial({ map: this.texture, side: THREE.DoubleSide }));
    const [x, y, z] = this.axes;
    receiver.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(x, y, z.clone().negate()));
    receiver.position.set(...origin);
    const light = new THREE.DirectionalLight(0xfff2df, 2.4);
    light.position.copy(z).multiplyScalar(-5).addScaledVector(y, 2).addScaledVector(x, 1.5);
    this.scene.add(receiver, light, new THREE.HemisphereLight(0xffffff, 0x8a7f99, 1.3));
    this.mesh = this.shadow = null;
  }

  // Faces of another mesh.
  setFaces(faces) {
    this.faces = faces;
    this.mesh?.geometry.dispose();
    this.mesh?.removeFromParent();
    this.mesh = null;
  }

  // Positions: Float32Array (3V); shadow: Uint8Array.
  update(positions, shadow) {
    if (!this.mesh) {
      const geometry = new THREE.BufferGeometry();
      geometry.setIndex(new THREE.BufferAttribute(this.faces, 1));
      for (const name of ["position", "normal"]) {
        geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(positions.length), 3).setUsage(THREE.DynamicDrawUsage));
      }
      this.mesh = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: this.clay, side: THREE.DoubleSide }));
      this.mesh.frustumCulled = false;
      this.scene.add(this.mesh);
    }
    const { position, normal } = this.mesh.geometry.attributes;
    position.array.set(positions);
    setNormals(position.array, this.faces, normal.array);
    position.needsUpdate = normal.needsUpdate = true;
    this.shadow = shadow;
    this.#project();
  }

  // Draws the shadow onto the wall.
  #project() {
    const pixels = new Uint32Array(this.texture.image.data.buffer);
    for (let i = 0; i < pixels.length; i++) pixels[i] = this.tones[this.shadow?.[i] ?? 255];
    this.texture.needsUpdate = true;
  }

  plan() {
    if (this.planned) return;
    this.planned = true;
    requestAnimationFrame(() => this.planned && this.render());
  }

  render() {
    this.planned = false;
    if (!this.axes) return;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, this.mostRatio));
    const size = this.renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height) this.renderer.setSize(width, height, false);
    const { turn, rise, distance } = this.view, [x, y, z] = this.axes;
    this.camera.position.copy(this.middle)
      .addScaledVector(x, distance * Math.sin(turn) * Math.cos(rise))
      .addScaledVector(y, distance * Math.sin(rise))
      .addScaledVector(z, -distance * Math.cos(turn) * Math.cos(rise));
    this.camera.up.copy(y);
    this.camera.lookAt(this.middle);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.fov = (360 / Math.PI) * Math.atan(FIELD / Math.min(this.camera.aspect || 1, 1));
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }

  turn(right, up, factor = 1) {
    const { view } = this;
    view.turn -= right;
    view.rise = Math.min(Math.max(view.rise + up, -1.5), 1.5);
    view.distance = Math.min(Math.max(view.distance * factor, 3), 30);
    this.plan();
  }

  #listen() {
    const { canvas } = this, pinch = new Pinch();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pinch.down(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      const change = pinch.move(event);
      if (change) this.turn(change.dx * 0.01, change.dy * 0.01, 1 / change.factor);
      else if (event.buttons) this.turn(event.movementX * 0.01, event.movementY * 0.01);
    });
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, (event) => pinch.up(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.turn(0, 0, Math.exp(Math.sign(event.deltaY) * 0.1));
    }, { passive: false });
    const restore = () => {
      this.view = { ...START };
      this.plan();
    };
    canvas.addEventListener("dblclick", restore);
    canvas.addEventListener("keydown", (event) => {
      const move = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1], "+": [0, 0, 0.9], "-": [0, 0, 1.1] };
      if (event.ctrlKey || event.metaKey || (event.key !== "0" && !(event.key in move))) return;
      event.preventDefault();
      if (event.key === "0") restore();
      else this.turn(...move[event.key]);
    });
  }
}

function colour([r, g, b]) {
  return new THREE.Color().setRGB(r / 255, g / 255, b / 255, THREE.SRGBColorSpace);
}

// Smooth normals, weighted by area.
function setNormals(p, faces, normals) {
  normals.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
    const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    for (const i of [a, b, c]) {
      normals[i] += x;
      normals[i + 1] += y;
      normals[i + 2] += z;
    }
  }
  for (let i = 0; i < normals.length; i += 3) {
    const length = Math.hypot(normals[i], normals[i + 1], normals[i + 2]) || 1;
    normals[i] /= length;
    normals[i + 1] /= length;
    normals[i + 2] /= length;
  }
}

function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const name = gl ? gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
