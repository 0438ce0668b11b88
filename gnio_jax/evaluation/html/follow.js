// Runs when the figures are drawn. `columns[run][sequence]` holds the data of the page; `paths`,
// `detail` and `marks` are what the figures draw.
const sequence = document.getElementById("sequence");
const run = document.getElementById("run");
const slider = document.getElementById("time");
const readout = document.getElementById("readout");
const rows = document.querySelectorAll("tr[data-sequence]");

const shown = (k) => columns[k][Number(sequence.value)];

// With NaN in the columns that another run has.
function whole(data) {
  const nothing = new Float32Array(data.time.length).fill(NaN);
  return Object.fromEntries(names.map((name) => [name, data[name] ?? nothing]));
}

function rowAt(time, seconds) {
  let row = 0;
  while (row + 1 < time.length && time[row + 1] <= seconds + 1e-4) row += 1;
  return row;
}

// The marker, the ellipse and the lines in the strips.
function move() {
  const seconds = Number(slider.value);
  const marked = ["time", "distance", "x", "y", "reference_x", "reference_y", "angle"];
  const at = columns.map((_, k) => rowAt(shown(k).data.time, seconds));
  const values = (name) => at.map((row, k) => shown(k).data[name][row]);
  const data = {colour: marks.data.colour, width: values("major").map((m) => 2 * m)};
  data.height = values("minor").map((m) => 2 * m);
  for (const name of marked) data[name] = values(name);
  marks.data = data;
  const k = Number(run.value);
  const parts = [`${data.time[k].toFixed(1)} s`, `x ${data.x[k].toFixed(1)} m, y ${data.y[k].toFixed(1)} m`];
  const error = values("error")[k];
  if (Number.isFinite(error)) parts.push(`error ${error.toFixed(2)} m`);
  if (Number.isFinite(data.width[k])) {
    parts.push(`3σ ${(data.width[k] / 2).toFixed(2)} × ${(data.height[k] / 2).toFixed(2)} m`);
  }
  readout.textContent = parts.join("  ·  ");
}

// The curves of the chosen sequence, and of the run whose network is looked at.
function choose(atEnd) {
  const before = Number(slider.value);
  paths.forEach((path, k) => { path.data = whole(shown(k).data); });
  const chosen = shown(Number(run.value)).data;
  detail.data = whole(chosen);
  const last = chosen.time.length - 1;
  const end = Math.max(chosen.time[last], 1e-3);
  slider.max = end;
  slider.step = end / Math.max(last, 1);
  slider.value = atEnd ? end : before;
  times.setv({start: 0, end: end});
  distances.setv({start: 0, end: Math.max(chosen.distance[last], 1e-3)});
  rows.forEach((row) => row.classList.toggle("chosen", row.dataset.sequence === sequence.value));
  move();
}

slider.addEventListener("input", move);
sequence.addEventListener("change", () => { choose(true); plan.reset.emit(); });
run.addEventListener("change", () => choose(false));
rows.forEach((row) => row.addEventListener("click", () => {
  sequence.value = row.dataset.sequence;
  sequence.dispatchEvent(new Event("change"));
}));
choose(true);
document.body.dataset.ready = "yes";
