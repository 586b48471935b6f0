// What is chosen, the panes with episodes, playing them, and input.

const SPEEDS = [1, 2, 5, 10, 20, 50];

let chosen = { history: 0, episode: 0, step: 0, ends: false }; // episode: position in the history's `shown`
let hovered = null; // number of the episode below the pointer on the curve
let playing = null; // time of the last frame while playing
let owed = 0; // steps that playing is behind

// ---- episodes

/** The episodes in the panes: the chosen one, or the first and the last. */
function shownEpisodes() {
  const episodes = decoded.get(chosen.history);
  return chosen.ends ? [episodes[0], episodes.at(-1)] : [episodes[chosen.episode]];
}

const lastStep = () => Math.max(...shownEpisodes().map((episode) => episode.frames - 1));

/** Make a pane for each shown episode. */
function makePanes() {
  const facts = currentFacts();
  const panes = shownEpisodes().map((episode) => {
    const pane = $("pane").content.cloneNode(true).firstElementChild;
    const total = facts.returns[episode.number];
    pane.querySelector("figcaption").textContent =
      `Episode ${episode.number + 1} of ${facts.episodes}, return ${total}` + agreement(episode);
    return pane;
  });
  $("panes").replaceChildren(...panes);
  $("panes").classList.toggle("single", panes.length === 1);
  $("scrub").max = String(lastStep());
  $("previous").disabled = chosen.ends || chosen.episode === 0;
  $("next").disabled = chosen.ends || chosen.episode === facts.shown.length - 1;
  $("ends").setAttribute("aria-pressed", String(chosen.ends));
  $("ends").disabled = facts.shown.length < 2;
}

/** The expert of a noise history is the oracle. */
const labeller = () => (currentFacts().source === "noise" ? "oracle" : "expert");

function agreement(episode) {
  if (!episode.expert_actions) return "";
  const steps = episode.frames - 1;
  let same = 0;
  for (let step = 0; step < steps; step++) same += episode.actions[step] === episode.expert_actions[step];
  return `; the ego acts as the ${labeller()} in ${same} of ${steps} steps`;
}

function drawPanes() {
  const layout = index.layouts[currentFacts().layout];
  const panes = [...$("panes").children];
  shownEpisodes().forEach((episode, number) => {
    const step = Math.min(chosen.step, episode.frames - 1);
    const [picture, strip] = panes[number].querySelectorAll("canvas");
    const tallest = (0.6 * window.innerHeight * layout.width) / (layout.height + layout.footer);
    panes[number].style.setProperty("--widest", `${Math.max(160, Math.min(tallest, 72 * layout.width))}px`);
    drawState(picture, layout, episode.records[step]);
    drawStrip(strip, episode, step);
    panes[number].querySelector("tbody").replaceChildren(...stepRows(episode, step));
    const caption = `episode ${episode.number + 1}, step ${step}, return so far ${episode.earned[step]}`;
    picture.setAttribute("aria-label", `State of the game: ${caption}`);
  });
  $("scrub").value = String(chosen.step);
  $("scrub").setAttribute("aria-valuetext", `step ${chosen.step} of ${lastStep()}`);
  $("play").textContent = playing === null ? "Play" : "Pause";
  $("start").disabled = $("back").disabled = chosen.step === 0;
  $("end").disabled = $("forward").disabled = chosen.step === lastStep();
}

/** Rewards over the episode: up and green, or down and red, with the current step. */
function drawStrip(canvas, episode, step) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const pen = sizedPen(canvas, width, height);
  const across = (frame) => (width * frame) / Math.max(1, episode.frames - 1);
  pen.fillStyle = colour("line");
  pen.fillRect(0, height / 2 - 0.5, width, 1);
  episode.rewards.forEach((reward, frame) => {
    if (reward === 0) return;
    pen.fillStyle = colour(reward > 0 ? "good" : "bad");
    pen.fillRect(across(frame), reward > 0 ? 1 : height / 2, Math.max(2, across(1)), height / 2 - 1);
  });
  pen.fillStyle = colour("text");
  pen.fillRect(Math.min(width - 2, across(step)), 0, 2, height);
}

function stepRows(episode, step) {
  const facts = currentFacts();
  const name = (actions) => (actions[step] === index.no_action ? "none, the episode is over" : index.actions[actions[step]]);
  const over = episode.actions[step] === index.no_action;
  const rows = [
    ["Step", `${step} of ${episode.frames - 1}`],
    ["Return so far", `${episode.earned[step]} of ${facts.returns[episode.number]}`],
    ["Reward of this step", over ? "" : signed(episode.rewards[step])],
    ["Ego's action", name(episode.actions), "ego"],
  ];
  const comparison = (actions) => (over ? "" : actions[step] === episode.actions[step] ? "same" : "other");
  const labels = { expert_actions: labeller() === "oracle" ? "Oracle" : "Expert", oracle_actions: "Oracle" };
  for (const [field, label] of Object.entries(labels)) {
    if (!episode[field]) continue;
    const style = comparison(episode[field]);
    const mark = style === "same" ? "same" : "differs";
    rows.push([`${label}'s action`, over ? "" : `${name(episode[field])} (${mark})`, style]);
  }
  if (episode.teammate_actions) rows.push(["Teammate's action", over ? "" : name(episode.teammate_actions), "teammate"]);
  return rows.map(([label, text, style]) => {
    const row = document.createElement("tr");
    const heading = row.appendChild(document.createElement("th"));
    heading.scope = "row";
    heading.textContent = label;
    const cell = row.appendChild(document.createElement("td"));
    cell.textContent = text || "\u2013";
    if (style) cell.className = style;
    return row;
  });
}

const signed = (number) => (number > 0 ? `+${number}` : String(number));

// ---- choosing

function fillSelect(select, options, value) {
  select.replaceChildren(
    ...options.map(([text, of]) => {
      const option = document.createElement("option");
      [option.textContent, option.value] = [text, String(of)];
      return option;
    }),
  );
  select.value = String(value);
}

const withNumbers = () => index.histories.map((facts, position) => ({ ...facts, position }));
const distinct = (values) => [...new Set(values)];

/** Show the lists of layouts, of its teammates, and of their histories. */
function fillChoice() {
  const facts = currentFacts();
  const onLayout = withNumbers().filter((one) => one.layout === facts.layout);
  const withTeammate = onLayout.filter((one) => one.teammate === facts.teammate);
  fillSelect($("layout"), distinct(index.histories.map((one) => one.layout)).map((name) => [name, name]), facts.layout);
  fillSelect($("teammate"), distinct(onLayout.map((one) => one.teammate)).map((name) => [name, name]), facts.teammate);
  fillSelect($("history"), withTeammate.map((one) => [historyLabel(one), one.position]), chosen.history);
  const earns = facts.expert_return === null ? "" : `; the expert earns ${facts.expert_return.toFixed(1)} an episode`;
  $("history-facts").textContent =
    `History ${facts.history_id}: ${facts.episodes} episodes, ${facts.steps.toLocaleString("en")} steps, source ` +
    `${facts.source}, split ${facts.split}, learner ${facts.learner}, task ${facts.task_id}${earns}.`;
  const [shown, all] = [facts.shown.length, facts.episodes];
  $("shown-text").textContent =
    shown === all
      ? "All episodes can be watched."
      : `${shown} of ${all} episodes can be watched, those with a mark below the curve: ${listed(facts.shown)}.`;
  $("mean-label").textContent = `mean of ${smoothing(all)}`;
}

const listed = (numbers) => numbers.map((number) => number + 1).join(", ");

function historyLabel({ history_id, source, split, learner, return_start, return_end }) {
  const curve = `${return_start.toFixed(1)} \u2192 ${return_end.toFixed(1)}`;
  return `${history_id}: return ${curve}, ${source}, ${split}` + (learner ? `, learner ${learner}` : "");
}

/** Show another history, episode, step or view, and draw everything. */
async function choose(change) {
  pause();
  const next = { ...chosen, ...change };
  let episodes;
  try {
    episodes = await episodesOf(next.history);
  } catch (error) {
    return complain(`This page is damaged: ${error.message}. Write it again.`);
  }
  next.episode = Math.min(next.episode, episodes.length - 1);
  chosen = next;
  hovered = null;
  chosen.step = Math.min(chosen.step, lastStep());
  fillChoice();
  makePanes();
  drawAll();
}

const chooseHistory = (history) => choose({ history, episode: 0, step: 0 });

const chooseEpisode = (number) => choose({ episode: currentFacts().shown.indexOf(nearest(number)), step: 0, ends: false });

function moveEpisode(by) {
  const episode = chosen.episode + by;
  if (!chosen.ends && episode >= 0 && episode < currentFacts().shown.length) choose({ episode, step: 0 });
}

function drawAll() {
  drawCurve();
  drawPanes();
  remember();
}

/** Keep the choice in the address, so that it can be copied and reloaded. */
function remember() {
  const { ends, step } = chosen;
  const facts = currentFacts();
  const values = { history: facts.history_id, episode: facts.shown[chosen.episode] + 1, step, ...(ends ? { ends: 1 } : {}) };
  window.history.replaceState(null, "", `#${new URLSearchParams(values)}`);
}

/** The choice in the address, where this page has it. */
function remembered() {
  const values = new URLSearchParams(location.hash.slice(1));
  const number = (name, otherwise) => (/^\d+$/.test(values.get(name) ?? "") ? Number(values.get(name)) : otherwise);
  const found = index.histories.findIndex((facts) => facts.history_id === number("history", -1));
  const history = Math.max(0, found);
  const { shown } = index.histories[history];
  const episode = shown.indexOf(number("episode", 0) - 1);
  return {
    history,
    episode: Math.max(0, episode),
    step: number("step", 0),
    ends: values.get("ends") === "1" && shown.length > 1,
  };
}

// ---- playing

function show(step) {
  chosen.step = Math.min(lastStep(), Math.max(0, step));
  drawPanes();
}

function pause() {
  playing = null;
  $("play").textContent = "Play";
}

function goTo(step) {
  pause();
  show(step);
  remember();
}

function togglePlay() {
  if (playing !== null) return goTo(chosen.step);
  if (chosen.step === lastStep()) chosen.step = 0;
  playing = performance.now();
  owed = 0;
  drawPanes();
  requestAnimationFrame(advance);
}

function advance(now) {
  if (playing === null) return;
  owed += (Math.min(1000, Math.max(0, now - playing)) / 1000) * Number($("speed").value);
  playing = now;
  const whole = Math.floor(owed);
  owed -= whole;
  if (whole) show(chosen.step + whole);
  if (chosen.step === lastStep()) return goTo(chosen.step);
  requestAnimationFrame(advance);
}

function changeSpeed(by) {
  const at = SPEEDS.indexOf(Number($("speed").value)) + by;
  $("speed").value = String(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, at))]);
}

// ---- input

const KEYS = {
  " ": togglePlay,
  ArrowLeft: () => goTo(chosen.step - 1),
  ArrowRight: () => goTo(chosen.step + 1),
  Home: () => goTo(0),
  End: () => goTo(lastStep()),
  p: () => moveEpisode(-1),
  n: () => moveEpisode(1),
  f: () => $("ends").click(),
  w: () => $("window").click(),
  "-": () => changeSpeed(-1),
  "+": () => changeSpeed(1),
  "=": () => changeSpeed(1),
};

const CURVE_KEYS = {
  ArrowLeft: () => moveEpisode(-1),
  ArrowRight: () => moveEpisode(1),
  ArrowDown: () => moveEpisode(-1),
  ArrowUp: () => moveEpisode(1),
  Home: () => chooseEpisode(0),
  End: () => chooseEpisode(currentFacts().episodes - 1),
};

function onKey(event) {
  const { target, key } = event;
  const keepsKey = target.matches("select") || (key === " " && target.matches("button, input[type=checkbox], summary"));
  if (keepsKey || event.ctrlKey || event.metaKey || event.altKey) return;
  const action = (target.id === "curve" && CURVE_KEYS[key]) || KEYS[key];
  if (!action) return;
  event.preventDefault();
  action();
}

function connect() {
  const first = (wanted) => withNumbers().find(wanted).position;
  $("layout").addEventListener("change", ({ target }) => chooseHistory(first((one) => one.layout === target.value)));
  $("teammate").addEventListener("change", ({ target }) => {
    const { layout } = currentFacts();
    chooseHistory(first((one) => one.layout === layout && one.teammate === target.value));
  });
  $("history").addEventListener("change", ({ target }) => chooseHistory(Number(target.value)));
  const curve = $("curve");
  const at = (event) => curveScales().episodeAt(event.clientX - curve.getBoundingClientRect().left);
  const hover = (episode) => ((hovered = episode), drawCurve());
  curve.addEventListener("pointermove", (event) => hover(at(event)));
  curve.addEventListener("pointerleave", () => hover(null));
  curve.addEventListener("click", (event) => chooseEpisode(at(event)));
  const clicks = {
    previous: () => moveEpisode(-1),
    next: () => moveEpisode(1),
    ends: () => choose({ ends: !chosen.ends, step: 0 }),
    start: () => goTo(0),
    back: () => goTo(chosen.step - 1),
    play: togglePlay,
    forward: () => goTo(chosen.step + 1),
    end: () => goTo(lastStep()),
  };
  for (const [id, action] of Object.entries(clicks)) $(id).addEventListener("click", action);
  $("scrub").addEventListener("input", ({ target }) => goTo(Number(target.value)));
  $("window").addEventListener("change", drawPanes);
  document.addEventListener("keydown", onKey);
  window.addEventListener("resize", drawAll);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  window.addEventListener("hashchange", () => choose(remembered()));
}

function complain(message) {
  $("problem").textContent = message;
  $("problem").hidden = false;
}

function describeRelease() {
  const { name, kind, version, histories } = index.release;
  const some = index.histories.length < histories ? `${index.histories.length} of its ${histories}` : `all ${histories}`;
  $("release-facts").textContent = `${kind} release ${version}; this page has ${some} histories.`;
  document.title = `ICRL4AHT histories: ${name}`;
  $("window-label").textContent = `Ego's ${index.window}\u00d7${index.window} window`;
}

/** Open the page; the promise is for tests, which wait for it. */
const opened = (async () => {
  if (typeof DecompressionStream === "undefined") {
    return complain("This browser is too old for this page, which needs DecompressionStream: use one from 2023 or later.");
  }
  try {
    index = JSON.parse(new TextDecoder().decode(await inflate(packed.index)));
  } catch (error) {
    return complain(`This page is damaged: ${error.message}. Write it again.`);
  }
  fillSelect($("speed"), SPEEDS.map((speed) => [String(speed), speed]), 10);
  describeRelease();
  connect();
  await choose(remembered());
})();
