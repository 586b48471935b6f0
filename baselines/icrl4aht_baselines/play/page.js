// The page of `play`: shows what the server sends, and sends keys. state.js draws states, curve.js has the axis' ticks.

const KEYS = { ArrowUp: "up", ArrowDown: "down", ArrowLeft: "left", ArrowRight: "right", " ": "interact", ".": "stay" };
const REPEAT_AFTER = 250; // milliseconds, so that a short press is one step
const RETRY_AFTER = 1000;
const TAKEN = 4000; // the server's code when all people of the game are connected
const LINES = ["accent", "quiet", "other", "good"];
const DASHES = [[], [2, 3], [8, 4], [8, 3, 2, 3]];

let socket, setup, frame;
let fading; // timer that removes the last reward
let held = null; // {action, since} of the key or button that is down

const send = (message) => socket?.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
const act = (name) => setup && send({ action: setup.actions.indexOf(name) });

function say(text) {
  $("problem").textContent = text;
  $("problem").hidden = !text;
}

function open() {
  socket = new WebSocket(`ws://${location.host}/play?slot=${setup ? setup.slot : ""}`);
  socket.onmessage = ({ data }) => receive(JSON.parse(data));
  socket.onclose = ({ code }) => {
    held = null;
    const lost = "The connection is lost; what you played is kept. This page connects again by itself.";
    say(code === TAKEN ? "Another browser already plays this game. Close it to play here; this page then connects by itself." : lost);
    setTimeout(open, RETRY_AFTER);
  };
}

function receive(message) {
  if (message.kind === "problem") return say(message.text);
  if (message.kind === "setup") {
    setup = message;
    $("title").textContent = `Play ${setup.name} with ${setup.partner === "human" ? "a second person" : setup.partner}`;
    $("consent").hidden = !setup.consent;
    $("consent-text").textContent = setup.consent;
    $("game").hidden = Boolean(setup.consent);
    $("window").checked = setup.view === "ego";
    return say("");
  }
  frame = message;
  for (const [part, drawings] of Object.entries(frame.drawings)) Object.assign(setup.layout.drawings[part], drawings);
  if (frame.reward) flash(frame.reward);
  if (held && held.action !== "interact" && performance.now() - held.since > REPEAT_AFTER) act(held.action);
  show();
}

/** Show a reward for longer than its step. */
function flash(reward) {
  $("reward").textContent = reward > 0 ? `+${reward}` : String(reward);
  $("reward").className = reward > 0 ? "good" : "bad";
  clearTimeout(fading);
  fading = setTimeout(() => ($("reward").textContent = ""), 2000);
}

function show() {
  if (!frame) return;
  const episode = Math.min(frame.returns.length + 1, setup.episodes);
  $("episode").textContent = `${episode} of ${setup.episodes}`;
  $("clock").textContent = `${frame.clock} of ${setup.steps}`;
  $("earned").textContent = String(frame.earned);
  $("next").textContent = whatNext(episode);
  $("game").classList.toggle("over", frame.over);
  if (frame.problem) say(frame.problem);
  draw();
  $("end").hidden = !frame.over;
  if (frame.over) showEnd();
}

function whatNext(episode) {
  if (frame.missing) return "Waiting for the other person.";
  if (!frame.waiting) return "";
  if (frame.ready) return "Waiting for the other person to press a key.";
  const last = frame.clock === 0 && frame.returns.length ? `You earned ${frame.returns.at(-1)}. ` : "";
  return `${last}Press an arrow key or touch a button to ${frame.clock ? "continue" : "start"} episode ${episode}.`;
}

function draw() {
  const { layout } = setup;
  const cells = $("window").checked ? setup.window : 0;
  const [width, height] = cells ? [cells, cells] : [layout.width, layout.height + layout.footer];
  const share = $("pad").offsetHeight ? 0.42 : 0.58; // of the window's height; the buttons for touch need space
  const room = Math.min($("board").clientWidth, (share * window.innerHeight * width) / height);
  $("picture").style.width = `${Math.max(200, Math.min(room, 72 * width))}px`;
  if ($("board").clientWidth) drawState($("picture"), layout, frame.record, cells);
}

function showEnd() {
  const curves = [["you", frame.returns], ...setup.compared.map((name) => [name, frame.references[name]])];
  const known = curves.filter(([, returns]) => returns?.length);
  drawChart(known.map(([, returns]) => returns));
  const keys = known.map(([name], line) => {
    const key = document.createElement("span");
    const mark = key.appendChild(document.createElement("i"));
    mark.className = "key";
    mark.style.borderTop = `3px ${line ? "dashed" : "solid"} var(--${LINES[line]})`;
    key.append(name);
    return key;
  });
  $("legend").replaceChildren(...keys);
  const mean = (returns) => (returns.reduce((sum, one) => sum + one, 0) / returns.length).toFixed(1);
  const sentences = curves.map(([name, returns]) => {
    if (!returns) return `${name}: being computed, this takes a moment`;
    return returns.length ? `${name}: ${mean(returns)} an episode on average` : `${name}: cannot play this layout`;
  });
  $("means").replaceChildren(...sentences.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  $("end-title").textContent = setup.compared.length ? `Thank you! Your returns by episode with ${setup.partner}, and those of other players` : "Thank you! Your returns by episode";
  $("recorded").textContent = frame.recorded && !frame.problem ? `Recorded in ${frame.recorded}` : "";
}

/** Draw returns by episode, one line for each player; the first one is the person's. */
function drawChart(curves) {
  const canvas = $("chart");
  const pen = sizedPen(canvas, canvas.clientWidth, canvas.clientHeight);
  const box = { left: 40, right: canvas.clientWidth - 12, top: 10, bottom: canvas.clientHeight - 28 };
  const [low, high] = [Math.min(0, ...curves.flat()), Math.max(20, ...curves.flat())];
  const across = (episode) => box.left + ((box.right - box.left) * (episode + 0.5)) / setup.episodes;
  const down = (value) => box.bottom - ((box.bottom - box.top) * (value - low)) / (high - low);
  drawTicks(pen, box, low, high, down);
  pen.textAlign = "center";
  for (let episode = 0; episode < setup.episodes; episode += Math.ceil(setup.episodes / 10)) {
    pen.fillText(String(episode + 1), across(episode), box.bottom + 14);
  }
  [...curves.entries()].reverse().forEach(([line, returns]) => { // the person's on top
    pen.strokeStyle = colour(LINES[line]);
    pen.lineWidth = line ? 1.5 : 3;
    pen.setLineDash(DASHES[line]);
    pen.beginPath();
    returns.forEach((value, episode) => pen.lineTo(across(episode), down(value)));
    pen.stroke();
    pen.setLineDash([]);
    if (!line) returns.forEach((value, episode) => dot(pen, across(episode), down(value), 4, colour("accent")));
  });
}

function press(action) {
  held = { action, since: performance.now() };
  act(action);
}

document.addEventListener("keydown", (event) => {
  const action = KEYS[event.key];
  if (!action || $("game").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.matches("#window") && event.key === " ") return; // space toggles the box
  event.preventDefault();
  if (!event.repeat) press(action);
});
document.addEventListener("keyup", ({ key }) => {
  if (held?.action === KEYS[key]) held = null;
});
for (const button of document.querySelectorAll("#pad button")) {
  button.addEventListener("pointerdown", () => press(button.dataset.action));
  for (const kind of ["pointerup", "pointercancel", "pointerleave"]) button.addEventListener(kind, () => (held = null));
  button.addEventListener("contextmenu", (event) => event.preventDefault());
}
window.addEventListener("blur", () => (held = null));
$("window").addEventListener("change", ({ target }) => {
  send({ view: target.checked ? "ego" : "whole" });
  target.blur(); // so that space acts again
  if (frame) draw();
});
$("consent").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ pseudonym: $("pseudonym").value, agrees: $("agrees").checked });
});
window.addEventListener("resize", show);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
open();
