// Connects the page with the server. Messages: see messages.py.

import { Painting } from "./painting.js";
import { Stage } from "./stage.js";
import { Zoom } from "./zoom.js";

const FACES = 1, FRAME = 2, TARGET = 3;
const RETRY_MS = 1000, NOTICE_MS = 5000;
const PHASES = {
  starting: "Preparing …", moving: "Following", resting: "At rest", failed: "Stopped", closed: "Closed", lost: "Connection lost",
};

const $ = (id) => document.getElementById(id);
const COLOURS = ["paper", "ink", "missing", "excess", "stage", "clay"]; // custom properties of the style sheet
const MOST_RADIUS = 60, RADIUS_STEP = 2;
const zoom = new Zoom($("easel"), $("sheet"), (scale) => {
  $("zoom-reset").textContent = `${Math.round(100 * scale)} %`;
});
const painting = new Painting($("shadow"), $("brush"), zoom, sendStroke);
let stage = null, socket = null, opened = null;
let sequence = 0; // of the last stroke message
let latest = null; // the newest frame, until it is shown
let resting = false; // the newest frame is the last one before a rest
let noticed = 0; // time until which a notice stays, ms
let planned = false;

try {
  stage = new Stage($("object"));
} catch (error) {
  warn("This browser shows no 3D graphics (WebGL): the shadow can be painted on, but the object is not seen.");
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => (typeof data === "string" ? onText(JSON.parse(data)) : onRecord(data));
  socket.onclose = ({ code, reason }) => {
    setPhase("lost");
    opened = null;
    // Codes of a server that has refused the page (1008: a message, 1013: too many pages). Otherwise the server may come back.
    if (code === 1008 || code === 1013) warn(`The server has closed the connection: ${reason}`);
    else setTimeout(connect, RETRY_MS);
  };
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function sendStroke(id, mode, radius, points) {
  sequence += 1;
  send({ type: "stroke", id, seq: sequence, mesh: opened?.mesh, mode, radius, points: points.map((v) => Math.round(v * 100) / 100) });
}

function onText(message) {
  if (message.type === "hello") {
    opened = message;
    sequence = 0;
    latest = null;
    resting = false;
    painting.open(message.width, message.height, message.points);
    stage?.open(message);
    showMeshes(message);
    showTargets(message.targets);
    for (const id of ["radius", "radius-number"]) $(id).max = Math.min(MOST_RADIUS, message.width, message.height);
    resize(painting.radius);
    zoom.reset();
    $("alert").hidden = Boolean(stage);
  } else if (message.type === "mesh") {
    Object.assign(opened, { name: message.name, mesh: message.mesh });
    latest = null;
    painting.drop();
    showMeshes(opened);
    zoom.reset();
  } else if (message.type === "status") {
    // The page shows a rest together with its last frame.
    resting = message.phase === "resting" && latest !== null;
    if (!resting) setPhase(message.phase);
    if (message.phase === "failed") warn(`The optimiser has stopped: ${message.message}`, true);
    else if (stage && performance.now() > noticed) $("alert").hidden = true;
  } else if (message.type === "notice") {
    noticed = performance.now() + NOTICE_MS;
    warn(message.message);
  }
}

function onRecord(buffer) {
  const words = new DataView(buffer), word = (k) => words.getUint32(4 * k, true);
  const kind = word(0);
  if (kind === FACES) stage?.setFaces(new Uint32Array(buffer, 8, 3 * word(1)));
  if (kind === TARGET) {
    $("undo").disabled = !word(3);
    $("redo").disabled = !word(4);
    // An older image would hide the last stroke for a moment.
    if (word(2) === sequence) painting.target = new Uint8Array(buffer, 20).slice();
    plan();
  }
  if (kind === FRAME) {
    const count = word(6);
    latest = {
      number: word(1), steps: word(2), target: word(3), loss: words.getFloat32(16, true), speed: words.getFloat32(20, true),
      vertices: new Float32Array(buffer, 28, 3 * count), shadow: new Uint8Array(buffer, 28 + 12 * count),
    };
    plan();
  }
}

function showMeshes({ name, meshes }) {
  const names = meshes.includes(name) ? meshes : [name, ...meshes];
  $("mesh").replaceChildren(...names.map((each) => new Option(each, each)));
  $("mesh").value = name;
  $("mesh").disabled = names.length < 2;
}

function showTargets(names) {
  const group = document.createElement("optgroup");
  group.label = "Figures";
  group.append(...names.filter((name) => name !== "blank").map((name) => new Option(name, name)));
  $("target").replaceChildren(
    new Option("Target …", ""), new Option("The mesh’s own shadow", "own"), new Option("Blank", "blank"), group,
  );
}

// Asks before a mesh is lost on which somebody has painted.
function chooseMesh(name) {
  const begin = () => send({ type: "mesh", name });
  const dialog = $("replace");
  if ($("undo").disabled && $("redo").disabled) {
    begin();
    return;
  }
  $("replace-title").textContent = `Begin with ${name}?`;
  dialog.returnValue = "";
  dialog.onclose = () => (dialog.returnValue === "yes" ? begin() : showMeshes(opened));
  dialog.showModal();
}

function chooseTarget(name) {
  if (name === "own") send({ type: "clear" });
  else if (name) send({ type: "target", name });
}

function paintColours() {
  const style = getComputedStyle(document.documentElement);
  const bytes = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
  const colours = Object.fromEntries(COLOURS.map((name) => [name, bytes(style.getPropertyValue(`--${name}`).trim())]));
  painting.setColours(colours);
  stage?.setColours(colours);
  $("theme").setAttribute("aria-pressed", String(globalThis.theme.dark));
  plan();
}

function plan() {
  if (planned) return;
  planned = true;
  requestAnimationFrame(show);
}

function show() {
  planned = false;
  painting.flush();
  if (!opened) return;
  const frame = latest;
  latest = null;
  if (frame) {
    painting.shadow = frame.shadow;
    stage?.update(frame.vertices, frame.shadow);
    stage?.render();
    $("speed").textContent = frame.speed ? `${frame.speed.toFixed(0)} steps/s` : "";
    send({ type: "seen", frame: frame.number });
  }
  const match = painting.draw();
  $("match").textContent = `${(100 * match).toFixed(1)} % match`;
  // For programs that watch the page.
  if (frame) document.dispatchEvent(new CustomEvent("frame", { detail: { ...frame, match } }));
  if (resting) {
    resting = false;
    setPhase("resting");
  }
}

function setPhase(phase) {
  document.body.dataset.phase = phase;
  $("phase").textContent = PHASES[phase] ?? phase;
}

function warn(reason, restart = false) {
  $("reason").textContent = reason;
  $("restart").hidden = !restart;
  $("alert").hidden = false;
}

async function load(file) {
  if (opened && file.size > opened.bytes) {
    warn(`The image cannot be used: it has ${file.size} bytes, ${opened.bytes} are allowed.`);
    return;
  }
  try {
    const answer = await fetch("image", { method: "POST", body: file, headers: { "content-type": "application/octet-stream" } });
    if (!answer.ok) warn(`The image cannot be used: ${await answer.text()}`);
    else $("alert").hidden = Boolean(stage);
  } catch (error) {
    warn(`The image could not be sent: ${error.message}`);
  }
}

function choose(mode) {
  painting.setMode(mode);
  for (const name of ["add", "erase"]) $(name).setAttribute("aria-pressed", String(name === mode));
}

function resize(radius) {
  const { min, max } = $("radius");
  const value = Math.min(Math.max(Math.round(radius) || 0, min), max);
  $("radius").value = $("radius-number").value = value;
  painting.setRadius(value);
}

function showMore(open) {
  $("extra").classList.toggle("open", open);
  $("more").setAttribute("aria-expanded", String(open));
}

// Keys that work everywhere, but not where one writes or chooses.
function onKey(event) {
  const key = event.key.toLowerCase();
  if (event.defaultPrevented || event.altKey || event.target.matches?.("input[type=number], select")) return;
  if (document.querySelector("dialog[open]")) {
    if (key === "?") $("help").close();
    return;
  }
  if (event.ctrlKey || event.metaKey) {
    if (key === "z" || key === "y") {
      event.preventDefault();
      send({ type: key === "y" || event.shiftKey ? "redo" : "undo" });
    }
  } else if (key === "b") choose("add");
  else if (key === "e") choose("erase");
  else if (key === "[") resize(painting.radius - RADIUS_STEP);
  else if (key === "]") resize(painting.radius + RADIUS_STEP);
  else if (key === "+" || key === "=") zoom.step(1);
  else if (key === "-" || key === "−") zoom.step(-1);
  else if (key === "0") zoom.reset();
  else if (key === "?") $("help").showModal();
  else if (key === "escape") showMore(false);
}

$("shadow").addEventListener("painted", plan);
$("shadow").addEventListener("contextmenu", (event) => event.preventDefault());
$("add").onclick = () => choose("add");
$("erase").onclick = () => choose("erase");
$("radius").oninput = (event) => resize(Number(event.target.value));
// While one writes, a number may be too small.
$("radius-number").oninput = ({ target }) => target.checkValidity() && target.value && resize(Number(target.value));
$("radius-number").onchange = ({ target }) => resize(Number(target.value || painting.radius));
$("zoom-in").onclick = () => zoom.step(1);
$("zoom-out").onclick = () => zoom.step(-1);
$("zoom-reset").onclick = () => zoom.reset();
$("mesh").onchange = ({ target }) => chooseMesh(target.value);
$("target").onchange = ({ target }) => {
  chooseTarget(target.value);
  target.value = "";
};
$("theme").onclick = () => globalThis.theme.toggle();
$("help-open").onclick = () => $("help").showModal();
$("help").onclick = ({ target }) => target === $("help") && $("help").close(); // beside the list
$("dismiss").onclick = () => ($("alert").hidden = true);
$("more").onclick = () => showMore($("more").getAttribute("aria-expanded") !== "true");
document.addEventListener("pointerdown", ({ target }) => {
  if (!target.closest("#extra, #more")) showMore(false);
});
for (const type of ["undo", "redo", "reset", "restart"]) $(type).onclick = () => send({ type });
$("load").onclick = () => $("file").click();
$("file").onchange = ({ target }) => {
  if (target.files.length) load(target.files[0]);
  target.value = "";
};
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", (event) => {
  event.preventDefault();
  if (event.dataTransfer.files.length) load(event.dataTransfer.files[0]);
});
document.addEventListener("keydown", onKey);
document.addEventListener("theme", paintColours);

paintColours();
connect();
