// Runs when the figures are drawn. `columns[run][sequence]` holds the data of the page; `paths`,
// `marks`, `starts` and `corners` are what the figures draw.
const sequence = document.getElementById("sequence");
const slider = document.getElementById("time");
const readout = document.getElementById("readout");
const whole = document.getElementById("whole");
const rows = document.querySelectorAll("tr[data-sequence]");

const shown = (run) => columns[run][Number(sequence.value)].data;

function rowAt(time, seconds) {
  let row = 0;
  while (row + 1 < time.length && time[row + 1] <= seconds + 1e-4) row += 1;
  return row;
}

// The marker, the ellipse and the lines in the strips.
function move() {
  const seconds = Number(slider.value);
  const at = columns.map((_, run) => rowAt(shown(run).time, seconds));
  const values = (name) => at.map((row, run) => shown(run)[name][row]);
  const data = {colour: marks.data.colour, width: values("major").map((m) => 2 * m)};
  data.height = values("minor").map((m) => 2 * m);
  for (const name of ["time", "x", "y", "reference_x", "reference_y", "angle"]) {
    data[name] = values(name);
  }
  marks.data = data;
  const place = Number.isFinite(data.x[0])
    ? `x ${data.x[0].toFixed(1)} m, y ${data.y[0].toFixed(1)} m` : "no position";
  const parts = [`${data.time[0].toFixed(1)} s`, place];
  const error = values("error")[0];
  if (Number.isFinite(error)) parts.push(`error ${error.toFixed(2)} m`);
  if (Number.isFinite(data.width[0])) {
    parts.push(`3σ ${(data.width[0] / 2).toFixed(2)} × ${(data.height[0] / 2).toFixed(2)} m`);
  }
  readout.textContent = parts.join("  ·  ");
}

// A legend names what the chosen sequence has: a renderer is called like its decisive column.
function explain() {
  const drawn = (renderer) => {
    const data = renderer.data_source === marks ? shown(0) : renderer.data_source.data;
    return !(renderer.name in data) || data[renderer.name].some(Number.isFinite);
  };
  for (const legend of legends) {
    for (const item of legend.items) item.visible = item.renderers.some(drawn);
  }
}

// A legend stands in one line where that is wide enough.
function fit() {
  const width = document.querySelector(".figures > div").clientWidth - 70;  // of the axis
  for (const legend of legends) {
    const wide = legend.items.filter((item) => item.visible)
      .reduce((sum, item) => sum + 32 + 6.5 * item.label.value.length, 0);
    legend.orientation = wide > width ? "vertical" : "horizontal";
  }
}

// The curves of the chosen sequence, at its end.
function choose() {
  paths.forEach((path, run) => { path.data = shown(run); });
  const first = shown(0), last = first.time.length - 1;
  const end = Math.max(first.time[last], 1e-3);
  starts.data = {
    x: columns.map((_, run) => shown(run).x[0]),
    y: columns.map((_, run) => shown(run).y[0]),
    colour: starts.data.colour,
  };
  corners.data = frames[Number(sequence.value)][Number(whole.checked)];
  slider.max = end;
  slider.step = (end / Math.max(last, 1)) * (1 - 1e-9);  // rounding must not make the end no step
  slider.value = end;
  times.setv({start: 0, end: end});
  rows.forEach((row) => row.classList.toggle("chosen", row.dataset.sequence === sequence.value));
  move();
  explain();
  fit();
}

slider.addEventListener("input", move);
window.addEventListener("resize", fit);
whole.addEventListener("change", () => {
  corners.data = frames[Number(sequence.value)][Number(whole.checked)];
  plan.reset.emit();
});
sequence.addEventListener("change", () => { choose(); plan.reset.emit(); });
rows.forEach((row) => row.addEventListener("click", () => {
  sequence.value = row.dataset.sequence;
  sequence.dispatchEvent(new Event("change"));
}));
choose();
document.body.dataset.ready = "yes";
