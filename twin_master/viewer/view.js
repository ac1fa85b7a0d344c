// Fills the figures of the page with the turns that the server tells, and moves through them.
//
// The page asks with the turns that it holds and the turn that it shows, and asks again once the answer is
// painted: a slow browser skips what it could not have shown, and one that was away gets what it missed.
"use strict";

const content = JSON.parse(document.getElementById("content").textContent);
const scene = content.scene;
const element = (id) => document.getElementById(id);
const numbers = (values) => values.map((value) => (value === null ? NaN : value));

const held = { first: 0, rows: [] }; // one row for each turn first, first + 1, ...
const state = { request: 0, flight: -1, wanted: scene.latest, shown: -1, count: -1, chosen: 0, ahead: null };
const sources = {};
let views = [];
let unpainted = new Set();
let socket = null;
let player = null;

// For whoever measures: [turn, time in ms since 1970 when it was painted], the last ones.
window.painted = [];

function end() {
  return held.first + held.rows.length;
}

function ask() {
  if (socket === null || socket.readyState !== WebSocket.OPEN) return;
  state.request += 1;
  socket.send(JSON.stringify({
    number: state.request, flight: state.flight, first: held.first, end: end(),
    turn: state.wanted, shown: state.shown, count: state.count,
  }));
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/turns`);
  socket.onopen = () => { notice(""); ask(); };
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => {
    notice("The connection was lost; trying again. What is missed meanwhile will be shown.");
    setTimeout(connect, 500);
  };
}

function notice(text) {
  element("notice").textContent = text;
  element("notice").hidden = text === "";
}

async function take(answer) {
  if (answer.error !== undefined) { notice(answer.error); return; }
  if (answer.number !== state.request) return; // of a turn that is not wanted any more
  keep(answer);
  const moved = state.shown !== answer.turn || answer.ahead !== null;
  state.shown = answer.turn;
  state.count = answer.count;
  if (answer.ahead !== null) state.ahead = answer.ahead;
  control(answer);
  picture(answer.picture);
  if (moved) {
    draw();
    await allPainted();
    window.painted.push([answer.turn, Date.now()]);
    if (window.painted.length > 5000) window.painted.splice(0, 2500);
  }
  if (answer.number === state.request) ask();
}

// Bokeh's own promise of a painted figure is never kept when a busy machine delays its timers.
async function allPainted() {
  unpainted = new Set(views);
  for (let frame = 0; frame < 60 && unpainted.size > 0; frame++) {
    await new Promise((resolve) => requestAnimationFrame(resolve));
  }
}

function keep(answer) {
  if (answer.past === null) { state.flight = answer.flight; return; }
  if (answer.flight !== state.flight || answer.first !== end()) {
    held.first = answer.first;
    held.rows = [];
    state.flight = answer.flight;
  }
  const columns = Object.entries(answer.past);
  for (let row = 0; row < answer.past.control.length; row++) {
    held.rows.push(Object.fromEntries(columns.map(([name, values]) => [name, values[row]])));
  }
  const surplus = held.rows.length - 2 * scene.window;
  if (surplus > 0) {
    held.rows.splice(0, surplus);
    held.first += surplus;
  }
}

function control(answer) {
  const slider = element("slider");
  slider.max = answer.count - 1;
  slider.value = answer.turn;
  slider.setAttribute("aria-valuetext", `${scene.step_name} ${answer.turn}`);
  element("count").textContent = `${scene.step_name} ${answer.turn} of ${answer.count - 1}`;
  element("latest").setAttribute("aria-pressed", String(state.wanted === scene.latest));
}

// Of the last verdict that was known at the turn shown, where motion was observed.
function picture(found) {
  element("force").hidden = found === null;
  if (found === null) return;
  if (element("picture").getAttribute("src") !== found.address) element("picture").src = found.address;
  element("verdict").textContent = found.said;
}

function bands(rows, turns) {
  const data = { turn: turns };
  const band = (column, name, index) => {
    for (const part of ["", "_lower", "_upper"]) {
      data[column + part] = numbers(rows.map((row) => row[name + part][index]));
    }
  };
  scene.factors.forEach((_, index) => band(`state${index}`, "state", index));
  scene.rewards.forEach((_, index) => band(`reward${index}`, "reward", index));
  band("chosen", "sensor", state.chosen);
  return data;
}

function draw() {
  const turn = state.shown;
  const begin = Math.max(0, turn + 1 - scene.window);
  const rows = held.rows.slice(begin - held.first, turn + 1 - held.first);
  const turns = rows.map((_, index) => begin + index);
  const past = bands(rows, turns);
  scene.factors.forEach((_, index) => {
    past[`state${index}_truth`] = numbers(rows.map((row) => row.truth[index]));
  });
  past.chosen_observed = numbers(rows.map((row) => row.observed[state.chosen]));
  const now = rows[rows.length - 1];
  const coming = rowsOf(state.ahead);
  sources.turns.setv({ start: begin - 1, end: Math.max(turn + scene.horizon + 1, 20) });
  sources.past.data = past;
  sources.present.data = bands([now], [turn]);
  sources.ahead.data = bands(coming, coming.map((_, index) => turn + 1 + index));
  drawControl(rows, turns, coming, turn);
  drawSensors(now);
  say(now, turn);
  drawNotices(rows, turns);
  drawLearnt(now);
}

function rowsOf(columns) {
  const names = Object.keys(columns);
  return columns.state.map((_, row) => Object.fromEntries(names.map((name) => [name, columns[name][row]])));
}

function bars(turns, rows) {
  const data = { turn: [], bottom: [], top: [], probability: [], control: [] };
  rows.forEach((probabilities, index) => probabilities.forEach((probability, row) => {
    if (probability < 1e-4) return;
    data.turn.push(turns[index]);
    data.bottom.push(row);
    data.top.push(row + scene.tallest_bar * probability);
    data.probability.push(probability);
    data.control.push(scene.controls[row]);
  }));
  return data;
}

function drawControl(rows, turns, coming, turn) {
  // What was concluded in a turn is the choice for the next one.
  sources.decided.data = bars(turns.map((value) => value + 1), rows.map((row) => row.probability));
  sources.expected.data = bars(
    coming.slice(1).map((_, index) => turn + 2 + index), coming.slice(1).map((row) => row.probability)
  );
  const flown = { left: [], right: [], row: [] };
  rows.forEach((row, index) => {
    const last = flown.row.length - 1;
    if (last >= 0 && flown.row[last] === row.control) {
      flown.right[last] = turns[index] + 0.5;
      return;
    }
    flown.left.push(turns[index] - 0.5);
    flown.right.push(turns[index] + 0.5);
    flown.row.push(row.control);
  });
  sources.flown.data = flown;
}

function drawSensors(now) {
  const observed = numbers(now.observed);
  const outside = observed.map((value, index) =>
    value < now.sensor_lower[index] || value > now.sensor_upper[index] ? value : NaN);
  sources.sensors.data = {
    number: observed.map((_, index) => index + 1), title: scene.sensors.titles, mean: numbers(now.sensor),
    lower: numbers(now.sensor_lower), upper: numbers(now.sensor_upper), observed, outside,
  };
  if (sources.places) {
    const places = sources.places.data;
    const lost = observed.map((value, index) => (Number.isNaN(value) ? places.y[index] : NaN));
    sources.places.data = { ...places, observed, lost };
  }
  if (sources.regions) {
    const said = scene.factors.map((factor, index) => estimate(factor, index, now));
    sources.regions.data = { ...sources.regions.data, loss: now.state, said };
  }
}

function estimate(factor, index, now) {
  const decimals = factor.highest - factor.lowest > 10 ? 0 : 2;
  const [mean, deviation] = [now.state[index], now.state_deviation[index]].map((value) => value.toFixed(decimals));
  return `${factor.symbol} ${mean} ± ${deviation} ${factor.unit}`;
}

function say(now, turn) {
  const next = now.probability.indexOf(Math.max(...now.probability));
  const health = scene.factors.map((factor, index) => estimate(factor, index, now)).join(", ");
  const lost = now.observed.filter((value) => value === null).length;
  const missing = lost ? ` ${lost} of ${now.observed.length} ${scene.sensors.word}s lost.` : "";
  element("said").textContent =
    `${scene.step_name} ${turn}: ${health}. Flown ${scene.controls[now.control]}; ` +
    `next ${scene.controls[next]} with probability ${now.probability[next].toFixed(3)}.${missing}`;
}

const MOST_NOTICES = 8;

// Each sentence once, with the turns in which it was said; the newest first.
function drawNotices(rows, turns) {
  const said = new Map();
  rows.forEach((row, index) => row.notices.forEach((sentence) => {
    const [first] = said.get(sentence) ?? [turns[index]];
    said.delete(sentence);
    said.set(sentence, [first, turns[index]]);
  }));
  const newest = [...said].reverse().slice(0, MOST_NOTICES);
  element("notices").replaceChildren(...newest.map(([sentence, [first, last]]) => {
    const item = document.createElement("li");
    const when = first === last ? `${scene.step_name} ${first}` : `${scene.step_name}s ${first} to ${last}`;
    const saysWhen = sentence.toLowerCase().startsWith(`${scene.step_name} `.toLowerCase());
    item.textContent = saysWhen ? sentence : `${when}: ${sentence}`;
    return item;
  }));
  element("told").hidden = newest.length === 0;
}

function drawLearnt(now) {
  const entries = Object.entries(now.learnt).sort(([a], [b]) =>
    a.includes("[") - b.includes("[") || a.localeCompare(b, "en", { numeric: true })); // those of a sensor last
  element("learnt").replaceChildren(...entries.map(([name, learnt]) => {
    const [row, term, value] = ["div", "dt", "dd"].map((tag) => document.createElement(tag));
    const [mean, lower, upper] = [learnt.mean, learnt.lower, learnt.upper].map((number) => number.toPrecision(4));
    term.textContent = name;
    value.textContent = `${mean} (${lower} to ${upper})${learnt.unit === "1" ? "" : ` ${learnt.unit}`}`;
    row.append(term, value);
    return row;
  }));
  element("learning").hidden = entries.length === 0;
}

function go(turn) {
  const last = state.count - 1;
  state.wanted = turn >= last ? scene.latest : Math.max(0, turn);
  ask();
}

function play(on) {
  clearInterval(player);
  player = null;
  element("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  if (state.shown === state.count - 1) go(0);
  player = setInterval(() => {
    if (state.shown >= state.count - 1 && state.wanted === scene.latest) play(false);
    else go(state.shown + 1);
  }, 1000 / Number(element("speed").value));
}

const keys = {
  ArrowLeft: () => go(state.shown - 1), ArrowRight: () => go(state.shown + 1),
  PageUp: () => go(state.shown - 10), PageDown: () => go(state.shown + 10),
  Home: () => go(0), End: () => go(state.count - 1), l: () => go(state.count - 1),
  " ": () => play(player === null),
};

function listen() {
  element("slider").addEventListener("input", (event) => { play(false); go(Number(event.target.value)); });
  element("latest").addEventListener("click", () => { play(false); go(state.count - 1); });
  element("play").addEventListener("click", () => play(player === null));
  element("speed").addEventListener("change", () => { if (player !== null) play(true); });
  element("chosen").addEventListener("change", (event) => {
    state.chosen = Number(event.target.value);
    if (state.ahead !== null) draw();
  });
  document.addEventListener("keydown", (event) => {
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const typing = event.target.tagName === "SELECT" || (event.key === " " && event.target.tagName === "BUTTON");
    if (act === undefined || typing || event.ctrlKey || event.altKey || event.metaKey || state.count < 1) return;
    event.preventDefault();
    if (event.key !== " ") play(false);
    act();
  });
}

async function begin() {
  await Bokeh.embed.embed_items(content.documents, content.items);
  const [shown] = Bokeh.documents;
  for (const model of shown._all_models.values()) {
    if (model.name) sources[model.name] = model;
  }
  views = shown.roots().map((root) => Bokeh.index.get_one(root));
  for (const view of views) {
    const repaint = view.repaint.bind(view);
    view.repaint = () => { repaint(); unpainted.delete(view); };
  }
  listen();
  connect();
}

begin();
