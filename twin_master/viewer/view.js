// Fills the figures of the page with the steps that the server tells, and moves through them.
//
// The page asks with the steps that it holds and the step that it shows, and asks again once the answer is
// painted: a slow browser skips what it could not have shown, and one that was away gets what it missed.
"use strict";

const scene = JSON.parse(document.getElementById("content").textContent);
const element = (id) => document.getElementById(id);
const numbers = (values) => values.map((value) => (value === null ? NaN : value));

const held = { first: 0, rows: [] }; // one row for each step first, first + 1, ...
const state = { request: 0, flight: -1, wanted: scene.latest, shown: -1, count: -1, chosen: 0, ahead: null };
const drawn = { past: [], ahead: [] }; // steps that are shown
let views = {};
let socket = null;
let player = null;

// For whoever measures: [step, time in ms since 1970 when it was painted], the last ones.
window.painted = [];

function end() {
  return held.first + held.rows.length;
}

function ask() {
  if (socket === null || socket.readyState !== WebSocket.OPEN) return;
  state.request += 1;
  socket.send(JSON.stringify({
    number: state.request, flight: state.flight, first: held.first, end: end(),
    step: state.wanted, shown: state.shown, count: state.count,
  }));
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/steps`);
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
  if (answer.number !== state.request) return; // of a step that is not wanted any more
  keep(answer);
  const moved = state.shown !== answer.step || answer.ahead !== null;
  state.shown = answer.step;
  state.count = answer.count;
  if (answer.ahead !== null) state.ahead = answer.ahead;
  control(answer);
  picture(answer.picture);
  if (moved) {
    draw();
    await onScreen();
    window.painted.push([answer.step, Date.now()]);
    if (window.painted.length > 5000) window.painted.splice(0, 2500);
  }
  if (answer.number === state.request) ask();
}

// What was drawn is on the screen behind the second frame.
async function onScreen() {
  for (let frame = 0; frame < 2; frame++) await new Promise((resolve) => requestAnimationFrame(resolve));
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
  slider.value = answer.step;
  slider.setAttribute("aria-valuetext", `${scene.step_name} ${answer.step}`);
  element("count").textContent = `${scene.step_name} ${answer.step} of ${answer.count - 1}`;
  element("latest").setAttribute("aria-pressed", String(state.wanted === scene.latest));
}

// Of the last verdict that was known at the step shown, where motion was observed.
function picture(found) {
  element("force").hidden = found === null;
  if (found === null) return;
  if (element("picture").getAttribute("src") !== found.address) element("picture").src = found.address;
  element("verdict").textContent = found.said;
}

function draw() {
  const step = state.shown;
  const begin = Math.max(0, step + 1 - scene.window);
  const rows = held.rows.slice(begin - held.first, step + 1 - held.first);
  const coming = rowsOf(state.ahead);
  drawn.past = rows.map((_, index) => begin + index);
  drawn.ahead = coming.map((_, index) => step + 1 + index);
  const range = [begin - 1, Math.max(step + scene.horizon + 1, 20)];
  const now = rows[rows.length - 1];
  scene.factors.forEach((_, index) => {
    const truth = rows.map((row) => row.truth[index]);
    course(views[`state${index}`], range, rows, coming, "state", index, [
      line(drawn.past, numbers(truth), COLOURS.truth, 'stroke-dasharray="6 3 1 3"'),
    ]);
  });
  scene.rewards.forEach((_, index) => course(views[`reward${index}`], range, rows, coming, "reward", index, []));
  const seen = numbers(rows.map((row) => row.observed[state.chosen]));
  course(views.chosen, range, rows, coming, "sensor", state.chosen, [
    marks(drawn.past, seen, "dot", 2, `fill="${COLOURS.observed}"`),
  ], seen);
  drawControl(range, rows, coming, step);
  drawSensors(now);
  say(now, step);
  drawNotices(rows, drawn.past);
  drawLearnt(now);
}

function rowsOf(columns) {
  const names = Object.keys(columns);
  return columns.state.map((_, row) => Object.fromEntries(names.map((name) => [name, columns[name][row]])));
}

// Past and prediction of one quantity, with bands; `more` is drawn as well, and `values` are to have room.
function course(view, range, rows, coming, name, index, more, values = []) {
  const parts = [[drawn.past, rows, COLOURS.present, ""], [drawn.ahead, coming, COLOURS.prediction, 'stroke-dasharray="6 4"']];
  const found = [], room = [...values];
  for (const [steps, own, colour, look] of parts) {
    const [mean, lower, upper] = ["", "_lower", "_upper"].map((part) => numbers(own.map((row) => row[name + part][index])));
    found.push(band(steps, lower, upper, colour), line(steps, mean, colour, look));
    room.push(...mean, ...lower, ...upper);
  }
  const ahead = numbers(coming.map((row) => row[name][index])), now = numbers([rows.at(-1)[name][index]]);
  found.push(...more, marks(drawn.ahead, ahead, "dot", 2, `fill="${COLOURS.prediction}"`));
  found.push(marks([state.shown], now, "diamond", 6, `fill="${COLOURS.present}"`));
  view.draw(range, room, found, (step) => {
    const row = step <= state.shown ? rows[step - drawn.past[0]] : coming[step - state.shown - 1];
    if (row === undefined) return null;
    const [mean, low, high] = ["", "_lower", "_upper"].map((part) => shortNumber(row[name + part][index] ?? NaN));
    return [`${scene.step_name} ${step}`, `${mean} ${view.options.unit}`, `95 %: ${low} to ${high}`];
  });
}

function drawControl(range, rows, coming, step) {
  // What was concluded in a step is the choice for the next one.
  const decided = rows.map((row, index) => [drawn.past[index] + 1, row.probability]);
  const expected = coming.slice(1).map((row, index) => [step + 2 + index, row.probability]);
  const found = [[decided, COLOURS.decision], [expected, COLOURS.prediction]].flatMap(([entries, colour]) =>
    scene.controls.map((_, control) => {
      const tops = entries.map(([, probability]) => control + scene.tallest_bar * probability[control]);
      return bars(entries.map(([at]) => at), tops.map(() => control), tops, 0.8, colour, 0.75);
    }));
  const flown = scene.controls.map((_, control) => {
    const own = rows.map((row) => (row.control === control ? control : NaN));
    const half = 0.5 * (1 - 1e-3);
    const steps = drawn.past.flatMap((at) => [at - half, at + half]);
    return line(steps, own.flatMap((value) => [value, value]), COLOURS.truth, 'style="stroke-width:4"');
  });
  const all = new Map([...decided, ...expected]);
  views.control.draw(range, [0], [...found, ...flown], (at) => {
    const probability = all.get(at);
    return probability === undefined ? null
      : [`${scene.step_name} ${at}`, ...scene.controls.map((name, index) => `${name}: ${probability[index].toFixed(3)}`)];
  });
}

function drawSensors(now) {
  const observed = numbers(now.observed), number = observed.map((_, index) => index + 1);
  const [mean, lower, upper] = [now.sensor, now.sensor_lower, now.sensor_upper].map(numbers);
  const outside = observed.map((value, index) => (value < lower[index] || value > upper[index] ? value : NaN));
  views.sensors.draw([0.4, observed.length + 0.6], [...observed, ...lower, ...upper], [
    bars(number, lower, upper, 0.62, COLOURS.present, 0.32),
    marks(number, mean, "dash", 6, `stroke="${COLOURS.present}" stroke-width="2"`),
    marks(number, observed, "dot", 2.5, `fill="${COLOURS.observed}"`),
    marks(number, outside, "square", 6, `fill="none" stroke="${COLOURS.prediction}" stroke-width="2"`),
  ], (at) => {
    const index = at - 1;
    if (observed[index] === undefined) return null;
    return [scene.sensors.titles[index], `observed ${shortNumber(observed[index])}`,
      `expected ${shortNumber(mean[index])} (${shortNumber(lower[index])} to ${shortNumber(upper[index])})`];
  });
  if (views.structure) {
    const said = scene.factors.map((factor, index) => estimate(factor, index, now));
    views.structure.draw(now.state, said, observed);
  }
}

function isBelieved(now) {
  return now.state.every((value) => value !== null);
}

function estimate(factor, index, now) {
  if (!isBelieved(now)) return `${factor.symbol}: not believed`;
  const decimals = factor.levels.at(-1) - factor.levels[0] > 10 ? 0 : 2;
  const [mean, deviation] = [now.state[index], now.state_deviation[index]].map((value) => value.toFixed(decimals));
  return `${factor.symbol} ${mean} ± ${deviation} ${factor.unit}`;
}

function say(now, step) {
  const next = now.probability.indexOf(Math.max(...now.probability));
  const health = isBelieved(now)
    ? scene.factors.map((factor, index) => estimate(factor, index, now)).join(", ")
    : `no state is believed, for none explains the ${scene.sensors.word}s`;
  const lost = now.observed.filter((value) => value === null).length;
  const missing = lost ? ` ${lost} of ${now.observed.length} ${scene.sensors.word}s lost.` : "";
  element("said").textContent =
    `${scene.step_name} ${step}: ${health}. Flown ${scene.controls[now.control]}; ` +
    `next ${scene.controls[next]} with probability ${now.probability[next].toFixed(3)}.${missing}`;
}

const MOST_NOTICES = 8;

// Each sentence once, with the steps in which it was said; the newest first.
function drawNotices(rows, steps) {
  const said = new Map();
  rows.forEach((row, index) => row.notices.forEach((sentence) => {
    const [first] = said.get(sentence) ?? [steps[index]];
    said.delete(sentence);
    said.set(sentence, [first, steps[index]]);
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

function learntTitle(name) { // "noise_scale[3]" is "noise scale, gauge 3"
  const [, quantity, number] = name.match(/^([^[]*)(?:\[(\d+)\])?/);
  const words = quantity.replaceAll("_", " ");
  return number ? `${words}, ${scene.sensors.titles[number - 1] ?? number}` : words;
}

function drawLearnt(now) {
  const entries = Object.entries(now.learnt).sort(([a], [b]) =>
    a.includes("[") - b.includes("[") || a.localeCompare(b, "en", { numeric: true })); // those of a sensor last
  element("learnt").replaceChildren(...entries.map(([name, learnt]) => {
    const [row, term, value] = ["div", "dt", "dd"].map((tag) => document.createElement(tag));
    const [mean, lower, upper] = [learnt.mean, learnt.lower, learnt.upper].map((number) => number.toPrecision(4));
    term.textContent = learntTitle(name);
    value.textContent = `${mean} (${lower} to ${upper})${learnt.unit === "1" ? "" : ` ${learnt.unit}`}`;
    row.append(term, value);
    return row;
  }));
  element("learning").hidden = entries.length === 0;
}

function go(step) {
  const last = state.count - 1;
  state.wanted = step >= last ? scene.latest : Math.max(0, step);
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

function build() {
  const { sensors, step_name: step } = scene, capital = (text) => text[0].toUpperCase() + text.slice(1);
  const measured = `damage of the regions, measured ${sensors.quantity} of the ${sensors.word}s`;
  if (scene.planform !== null) {
    views.structure = new Structure(element("structure"), `The wing from above: ${measured}`, scene.planform, sensors, scene.factors);
  } else if (scene.part !== null) {
    views.structure = new Structure(element("structure"), `The part: ${measured}`, scene.part, sensors, scene.factors);
  }
  scene.factors.forEach((factor, index) => {
    const [low, high] = [factor.levels[0], factor.levels.at(-1)], margin = 0.06 * (high - low) || 1;
    const options = { unit: `${factor.symbol} (${factor.unit})`, height: 175, range: [low - margin, high + margin] };
    views[`state${index}`] = new Plot(element("states"), capital(factor.title), options);
  });
  const rows = scene.controls.length, control = { height: 50 + 55 * rows, names: scene.controls, range: [-0.06, rows + 0.04] };
  views.control = new Plot(element("states"), "Control: flown (line), probability of the choice (bars)", control);
  const unit = `${sensors.quantity} (${sensors.unit})`;
  const title = `All ${sensors.word}s at this ${step}: expected, 95 %, observed; square: outside its interval`;
  views.sensors = new Plot(element("plots"), title, { unit, height: 215, titles: sensors.named ? sensors.titles : [] });
  views.chosen = new Plot(element("plots"), `One ${sensors.word} over the ${step}s`, { unit, height: 210 });
  scene.rewards.forEach((name, index) => {
    views[`reward${index}`] = new Plot(element("rows"), `${capital(name)} reward`, { unit: "reward", height: 140 });
  });
}

for (const name of ["told", "force", "learning"]) element(name).hidden = true; // until there is something to show
build();
listen();
connect();
