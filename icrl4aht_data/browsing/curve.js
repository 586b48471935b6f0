// The learning curve of the chosen history, with a cursor.

const currentFacts = () => index.histories[chosen.history];
const smoothing = (episodes) => Math.max(5, Math.floor(episodes / 20));

/** Mean of each value and its neighbours, in windows of `width` or less at the ends. */
function runningMean(values, width) {
  return values.map((_, at) => {
    const near = values.slice(Math.max(0, at - Math.floor(width / 2)), at + Math.ceil(width / 2));
    return near.reduce((sum, value) => sum + value, 0) / near.length;
  });
}

/** Round numbers that divide the range from low to high into about four parts. */
function ticks(low, high) {
  const rough = (high - low) / 4;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough);
  const found = [];
  for (let tick = Math.ceil(low / step); tick * step <= high; tick++) found.push(tick * step);
  return found;
}

/** Where episodes and returns are on the curve's canvas. */
function curveScales() {
  const { returns } = currentFacts();
  const box = { left: 44, right: $("curve").clientWidth - 10, top: 10, bottom: $("curve").clientHeight - 26 };
  let [low, high] = [Math.min(0, ...returns), Math.max(0, ...returns)];
  if (high === low) high = low + 20; // one value: an axis all the same
  const across = (episode) => box.left + ((box.right - box.left) * (episode + 0.5)) / returns.length;
  const down = (value) => box.bottom - ((box.bottom - box.top) * (value - low)) / (high - low);
  const episodeAt = (x) => {
    const episode = Math.floor(((x - box.left) / (box.right - box.left)) * returns.length);
    return Math.min(returns.length - 1, Math.max(0, episode));
  };
  return { box, low, high, across, down, episodeAt };
}

/** Draw the ticks of returns between two values, and choose the font of further texts. */
function drawTicks(pen, box, low, high, down) {
  pen.font = "12px system-ui, sans-serif";
  pen.textBaseline = "middle";
  pen.textAlign = "right";
  for (const tick of ticks(low, high)) {
    pen.fillStyle = colour("line");
    pen.fillRect(box.left, Math.round(down(tick)), box.right - box.left, 1);
    pen.fillStyle = colour("quiet");
    pen.fillText(String(Number(tick.toPrecision(6))), box.left - 7, down(tick));
  }
}

function drawCurve() {
  const { returns, shown } = currentFacts();
  const canvas = $("curve");
  const { box, low, high, across, down } = curveScales();
  const pen = sizedPen(canvas, canvas.clientWidth, canvas.clientHeight);
  const trace = (values, name, width) => {
    pen.strokeStyle = colour(name);
    pen.lineWidth = width;
    pen.lineJoin = "round";
    pen.beginPath();
    values.forEach((value, episode) => pen.lineTo(across(episode), down(value)));
    pen.stroke();
  };
  drawTicks(pen, box, low, high, down);
  const lastTick = returns.length > 1 ? [0, returns.length - 1] : [0];
  for (const episode of lastTick) {
    pen.textAlign = episode ? "right" : "left";
    pen.fillText(String(episode + 1), episode ? box.right : box.left, box.bottom + 15);
  }
  pen.textAlign = "center";
  pen.fillText("episode", (box.left + box.right) / 2, box.bottom + 15);
  if (shown.length < returns.length) { // the episodes that can be watched
    pen.fillStyle = colour("accent");
    for (const episode of shown) pen.fillRect(across(episode) - 0.75, box.bottom + 1, 1.5, 5);
  }
  trace(returns, "raw", 1);
  trace(runningMean(returns, smoothing(returns.length)), "accent", 2);
  if (hovered !== null) {
    pen.fillStyle = colour("quiet");
    pen.fillRect(across(hovered), box.top, 1, box.bottom - box.top);
    dot(pen, across(hovered), down(returns[hovered]), 3.5, colour("quiet"));
  }
  for (const { number } of shownEpisodes()) {
    dot(pen, across(number), down(returns[number]), 6, colour("card"));
    dot(pen, across(number), down(returns[number]), 4.5, getComputedStyle(document.querySelector(".key.chosen")).backgroundColor);
  }
  const described = (number) => `Episode ${number + 1} of ${returns.length}, return ${returns[number]}`;
  const watched = shownEpisodes().map((episode) => described(episode.number)).join("; ");
  $("curve-text").textContent =
    hovered === null ? watched : `${described(hovered)}: click to watch ${shown.includes(hovered) ? "it" : nearest(hovered) + 1}`;
  canvas.setAttribute("aria-valuemax", String(returns.length));
  canvas.setAttribute("aria-valuenow", String(shownEpisodes()[0].number + 1));
  canvas.setAttribute("aria-valuetext", watched);
}

function dot(pen, x, y, radius, fill) {
  pen.fillStyle = fill;
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  pen.fill();
}

/** The episode with frames that is nearest to an episode number. */
function nearest(number) {
  const away = (episode) => Math.abs(episode - number);
  return currentFacts().shown.reduce((best, episode) => (away(episode) < away(best) ? episode : best));
}

