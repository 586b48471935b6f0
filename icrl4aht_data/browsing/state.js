"use strict";
// From the embedded bytes to episodes, and from a state record to a picture. The game's facts (layouts, drawings,
// actions) are in the index, which page.py computes: nothing here knows the rules.

const $ = (id) => document.getElementById(id);
const packed = JSON.parse($("data").textContent);

let index; // what page.py describes
const decoded = new Map(); // position of a history -> its episodes

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Split the columns of a history, bytes (S + columns) * F, into its episodes. */
function splitEpisodes(facts, bytes) {
  const size = index.layouts[facts.layout].record_size;
  const total = facts.frames.reduce((sum, frames) => sum + frames, 0);
  if (bytes.length !== total * (size + facts.columns.length)) {
    throw new Error(`history ${facts.history_id}: expected ${total} frames, found ${bytes.length} bytes`);
  }
  const column = (number, first, frames) => bytes.subarray(number * total + first, number * total + first + frames);
  let first = 0;
  return facts.frames.map((frames, position) => {
    const episode = { number: facts.shown[position], frames, records: [] };
    for (let frame = 0; frame < frames; frame++) {
      const record = new Uint8Array(size);
      for (let number = 0; number < size; number++) record[number] = bytes[number * total + first + frame];
      episode.records.push(record);
    }
    facts.columns.forEach((name, number) => (episode[name] = column(size + number, first, frames)));
    episode.rewards = Int8Array.from(episode.rewards, (value) => (value << 24) >> 24);
    episode.earned = [0]; // before each frame
    for (const reward of episode.rewards) episode.earned.push(episode.earned.at(-1) + reward);
    first += frames;
    return episode;
  });
}

async function episodesOf(position) {
  if (!decoded.has(position)) {
    decoded.set(position, splitEpisodes(index.histories[position], await inflate(packed.histories[position])));
  }
  return decoded.get(position);
}

// ---- drawing a state

/** Draw shapes around (x, y), where a cell has `unit` pixels; drawings.py lists the kinds of shapes. */
function drawShapes(pen, shapes, x, y, unit) {
  const across = (value) => (x + value) * unit;
  const down = (value) => (y + value) * unit;
  for (const [kind, ...values] of shapes) {
    if (kind === "box") {
      const [bx, by, width, height, fill, radius] = values;
      pen.fillStyle = fill;
      pen.beginPath();
      pen.roundRect(across(bx - width / 2), down(by - height / 2), width * unit, height * unit, radius * unit);
      pen.fill();
    } else if (kind === "disc" || (kind === "line" && values.length === 4)) {
      // browsers draw nothing for a line of one point
      const [dx, dy, radius, fill, part] = kind === "disc" ? values : [values[2], values[3], values[0] / 2, values[1], 1];
      pen.fillStyle = fill;
      pen.beginPath();
      if (part < 1) pen.moveTo(across(dx), down(dy));
      pen.arc(across(dx), down(dy), radius * unit, -Math.PI / 2, Math.PI * (2 * part - 0.5));
      pen.fill();
    } else if (kind === "line") {
      const [thickness, fill, ...ends] = values;
      pen.strokeStyle = fill;
      pen.lineWidth = thickness * unit;
      pen.lineCap = pen.lineJoin = "round";
      pen.beginPath();
      pen.moveTo(across(ends[0]), down(ends[1]));
      for (let end = 0; end < ends.length; end += 2) pen.lineTo(across(ends[end]), down(ends[end + 1]));
      pen.stroke();
    } else if (kind === "frame") {
      const [left, top, right, bottom, thickness, fill] = values;
      pen.strokeStyle = fill;
      pen.lineWidth = thickness * unit;
      pen.lineJoin = "miter";
      const width = right - left - thickness;
      const height = bottom - top - thickness;
      pen.strokeRect(across(left + thickness / 2), down(top + thickness / 2), width * unit, height * unit);
    } else if (kind === "text") {
      const [tx, ty, words, size, fill, anchor, room] = values;
      pen.fillStyle = fill;
      const font = (pixels) => (pen.font = `500 ${pixels}px system-ui, sans-serif`);
      font(size * unit);
      font(size * unit * Math.min(1, (room * unit) / pen.measureText(words).width));
      pen.textAlign = { l: "left", m: "center", r: "right" }[anchor[0]];
      pen.textBaseline = "middle";
      pen.fillText(words, across(tx), down(ty));
    } else {
      throw new Error(`unknown shape ${kind}`);
    }
  }
}

/** Draw a state; with `cells`, only a square of so many cells around the ego, without the recipe. */
function drawState(canvas, layout, record, cells = 0) {
  const width = cells || layout.width;
  const unit = Math.min(canvas.parentElement.clientWidth, canvas.clientWidth) / width;
  const pen = sizedPen(canvas, unit * width, unit * (cells || layout.height + layout.footer));
  const showsWindow = $("window").checked && !cells;
  if (cells) {
    const ego = record[layout.parts.find(([name]) => name === layout.view)[2]];
    const shift = (position) => (Math.floor(cells / 2) - position) * unit;
    pen.translate(shift(ego % layout.width), shift(Math.floor(ego / layout.width)));
  }
  let seen = null; // the ego's window
  pen.fillStyle = layout.paper;
  pen.fillRect(0, 0, layout.width * unit, (layout.height + (cells ? 0 : layout.footer)) * unit);
  for (const [name, moves, anchor, columns] of layout.parts) {
    const cell = moves ? record[anchor] : anchor;
    const x = (cell % layout.width) + 0.5;
    const y = Math.floor(cell / layout.width) + 0.5;
    if (cells && (name === layout.view || name === "recipe")) continue;
    const shapes = layout.drawings[name][columns.map((column) => record[column]).join(",")];
    if (name === layout.view) {
      const [, left, top, right, bottom] = shapes[0];
      seen = [x + left, y + top, right - left, bottom - top];
      if (!showsWindow) continue;
    }
    drawShapes(pen, shapes, x, y, unit);
  }
  if (showsWindow) { // all but the window gets darker
    pen.fillStyle = "rgba(20, 24, 32, 0.42)";
    pen.beginPath();
    pen.rect(0, 0, layout.width * unit, layout.height * unit);
    pen.rect(...seen.map((value) => value * unit));
    pen.fill("evenodd");
  }
}

/** Size a canvas for the screen's pixels and return its context, which draws in CSS pixels. */
function sizedPen(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return pen;
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

