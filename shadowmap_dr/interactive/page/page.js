// Connects the page with the server. Messages: see messages.py.

import { Painting } from "./painting.js";
import { Stage } from "./stage.js";

const FACES = 1, FRAME = 2, TARGET = 3;
const RETRY_MS = 1000, NOTICE_MS = 5000;
const PHASES = {
  starting: "Preparing …", moving: "Following", resting: "At rest", failed: "Stopped", closed: "Closed", lost: "Connection lost",
};

const $ = (id) => document.getElementById(id);
const painting = new Painting($("shadow"), $("brush"), sendStroke);
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
  send({ type: "stroke", id, seq: sequence, mode, radius, points: points.map((v) => Math.round(v * 100) / 100) });
}

function onText(message) {
  if (message.type === "hello") {
    opened = message;
    sequence = 0;
    latest = null;
    resting = false;
    painting.open(message.width, message.height, message.points);
    stage?.open(message);
    $("name").textContent = message.name;
    $("alert").hidden = Boolean(stage);
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
    $("speed").textContent = frame.speed ? `${frame.speed.toFixed(0)} steps a second` : "";
    send({ type: "seen", frame: frame.number });
  }
  const match = painting.draw();
  $("match").textContent = `${(100 * match).toFixed(1)} % of the shadow is as wanted`;
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
  $("radius").value = Math.min(Math.max(radius, min), max);
  painting.setRadius(Number($("radius").value));
}

$("shadow").addEventListener("painted", plan);
$("shadow").addEventListener("contextmenu", (event) => event.preventDefault());
$("add").onclick = () => choose("add");
$("erase").onclick = () => choose("erase");
$("radius").oninput = (event) => painting.setRadius(Number(event.target.value));
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
document.addEventListener("keydown", (event) => {
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey) {
    if (key === "z" || key === "y") {
      event.preventDefault();
      send({ type: key === "y" || event.shiftKey ? "redo" : "undo" });
    }
  } else if (key === "b") choose("add");
  else if (key === "e") choose("erase");
  else if (key === "[") resize(painting.radius - 2);
  else if (key === "]") resize(painting.radius + 2);
});

connect();
