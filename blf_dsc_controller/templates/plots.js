// SPDX-License-Identifier: Apache-2.0
// Draws the panels and the arm from the data of the page; nothing is loaded from elsewhere.
'use strict';

const data = JSON.parse(document.getElementById('data').textContent);
const timePlots = [];
const duration = Math.max(...data.arms.map((arm) => arm.time[arm.time.length - 1]));
let following = false;

// Legends are below: above they would cover the title, beside it take half of a narrow plot.
function legendHeight(panel, width) {
  const names = panel.traces.filter((trace) => trace.showlegend !== false).map((one) => one.name);
  const entry = 45 + 6.5 * Math.max(0, ...names.map((name) => name.length));
  return 19 * Math.ceil(names.length / Math.max(1, Math.floor(width / entry)));
}

function layoutOf(panel, width) {
  const legend = legendHeight(panel, width - 110);
  const grid = {gridcolor: '#e5e7eb', zerolinecolor: '#d1d5db'};
  return {
    title: {text: panel.title, x: 0.01, xanchor: 'left', font: {size: 14}},
    height: 270 + legend,
    margin: {l: 62, r: 34, t: 34, b: 46 + legend},
    paper_bgcolor: 'white', plot_bgcolor: 'white', bargap: 0, barmode: 'overlay',
    legend: {font: {size: 11}, orientation: 'h', x: 0, xanchor: 'left', yref: 'container', y: 0,
      yanchor: 'bottom'},
    modebar: {orientation: 'v'},
    font: {family: 'system-ui, DejaVu Sans, sans-serif', size: 12, color: '#22272e'},
    hovermode: panel.time ? 'x' : 'closest',
    dragmode: 'zoom',
    xaxis: {...grid, title: {text: panel.time ? 'time [s]' : `[${panel.unit}]`, standoff: 6},
      ...(panel.time ? {range: [0, duration]} : {})},
    yaxis: {...grid, title: {text: panel.time ? panel.unit : 'count', standoff: 4},
      type: panel.log ? 'log' : 'linear', exponentformat: 'power'},
    shapes: panel.marks.flatMap(([time, , colour, until]) => [
      {type: 'line', x0: time, x1: time, y0: 0, y1: 1, yref: 'paper',
        line: {color: colour, width: 1.2, dash: 'dot'}},
      ...(until > time ? [{type: 'rect', x0: time, x1: until, y0: 0, y1: 1, yref: 'paper',
        layer: 'below', fillcolor: colour, opacity: 0.12, line: {width: 0}}] : [])]),
    annotations: panel.marks.map(([time, text, colour], row) => ({x: time, y: 1, yref: 'paper',
      yanchor: 'top', yshift: -13 * row, xanchor: 'left', text, showarrow: false,
      font: {size: 11, color: colour}})),
  };
}

// Zooming one panel over time zooms all of them.
function follow(source, change) {
  if (following) return;
  let update = null;
  if (change['xaxis.autorange']) update = {'xaxis.autorange': true};
  if (change['xaxis.range[0]'] !== undefined) {
    update = {'xaxis.range': [change['xaxis.range[0]'], change['xaxis.range[1]']]};
  }
  if (!update) return;
  following = true;
  const others = timePlots.filter((plot) => plot !== source);
  Promise.all(others.map((plot) => Plotly.relayout(plot, {...update})))
    .finally(() => { following = false; });
}

function draw(panel, place) {
  const traces = panel.traces.map((trace) => ({mode: 'lines', connectgaps: false, ...trace}));
  const options = {responsive: true, displaylogo: false, scrollZoom: false};
  return Plotly.newPlot(place, traces, layoutOf(panel, place.clientWidth), options).then(() => {
    if (!panel.time) return;
    timePlots.push(place);
    place.on('plotly_relayout', (change) => follow(place, change));
  });
}

async function drawAll() {
  const plots = document.getElementById('plots');
  const places = [];
  let group = '';
  let grid = null;
  for (const panel of data.panels) {
    if (panel.group !== group) {
      group = panel.group;
      const heading = document.createElement('h2');
      heading.textContent = group;
      heading.id = group.toLowerCase().replaceAll(' ', '-');
      grid = document.createElement('div');
      grid.className = 'grid';
      plots.append(heading, grid);
    }
    const place = document.createElement('div');
    place.className = 'plot';
    grid.append(place);
    places.push([panel, place]);
  }
  for (const [panel, place] of places) {
    await draw(panel, place);
    // Between two plots the browser gets to show what there is.
    await new Promise((resolve) => { setTimeout(resolve, 0); });
  }
  window.reportReady = performance.now();
}

const canvas = document.getElementById('arm');
const slider = document.getElementById('arm-time');
const clock = document.getElementById('arm-clock');
const play = document.getElementById('arm-play');
let playing = null;

const plus = (a, b) => a.map((one, k) => one + b[k]);
const times = (R, v) => R.map((row) => row.reduce((sum, one, k) => sum + one * v[k], 0));
const product = (A, B) => A.map((row) => [0, 1, 2].map(
  (k) => row.reduce((sum, one, j) => sum + one * B[j][k], 0)));

function turn([x, y, z], angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const d = 1 - c;
  return [[c + d * x * x, d * x * y - s * z, d * x * z + s * y],
    [d * x * y + s * z, c + d * y * y, d * y * z - s * x],
    [d * x * z - s * y, d * y * z + s * x, c + d * z * z]];
}

// Base, joints and tip [m] in the base.
function points(arm, positions) {
  let R = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const found = [[0, 0, 0]];
  arm.joints.forEach(([rotation, offset, axis, slides], i) => {
    let place = plus(found[i], times(R, offset));
    R = product(R, rotation);
    if (slides) place = plus(place, times(R, axis.map((one) => positions[i] * one)));
    else R = product(R, turn(axis, positions[i]));
    found.push(place);
  });
  return [...found, plus(found[found.length - 1], times(R, arm.tip))];
}

// Arms in a plane are seen from the front, others from above and aside; dragging turns the view.
const planar = data.arms.every((arm) => arm.joints.every(
  ([, offset, axis]) => offset[1] === 0 && offset[2] === 0 && axis[1] === -1));
const view = planar ? {yaw: 0, pitch: 0} : {yaw: -0.6, pitch: 0.35};

function seen([x, y, z]) {
  const [c, s] = [Math.cos(view.yaw), Math.sin(view.yaw)];
  const depth = s * x + c * y;
  return [c * x - s * y, z * Math.cos(view.pitch) + depth * Math.sin(view.pitch)];
}

canvas.addEventListener('pointermove', (event) => {
  if (!event.buttons) return;
  view.yaw += 0.01 * event.movementX;
  view.pitch += 0.01 * event.movementY;
  showArm();
});

function drawArm(time) {
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = width * scale;
  canvas.height = height * scale;
  const pen = canvas.getContext('2d');
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  const reach = Math.max(...data.arms.map((arm) => [...arm.joints.map((joint) => joint[1]), arm.tip]
    .reduce((sum, offset) => sum + Math.hypot(...offset), 0)));
  const unit = 0.46 * Math.min(width, height) / reach;
  const place = (point) => {
    const [x, y] = seen(point);
    return [width / 2 + unit * x, height / 2 - unit * y];
  };
  const line = (corners, colour, thickness) => {
    pen.strokeStyle = colour;
    pen.lineWidth = thickness;
    pen.lineCap = pen.lineJoin = 'round';
    pen.beginPath();
    corners.map(place).forEach(([x, y]) => pen.lineTo(x, y));
    pen.stroke();
  };
  line([[-reach, 0, 0], [reach, 0, 0]], '#e5e7eb', 1);
  if (!planar) line([[0, -reach, 0], [0, reach, 0]], '#e5e7eb', 1);
  for (const arm of data.arms) {
    const last = arm.time.length - 1;
    const k = Math.min(last, Math.round(time / arm.time[last] * last) || 0);
    const corners = points(arm, arm.angles[k]);
    line(corners, arm.colour, 6);
    corners.map(place).forEach(([x, y]) => {
      pen.fillStyle = arm.colour;
      pen.beginPath();
      pen.arc(x, y, 6, 0, 7);
      pen.fill();
    });
    if (arm.reference.length) line(points(arm, arm.reference[k]), '#22272e', 1.5);
  }
  clock.textContent = `${time.toFixed(2)} s`;
  canvas.dataset.time = time;
}

function showArm() { drawArm(slider.value / 1000 * duration); }

play.addEventListener('click', () => {
  playing = playing === null ? performance.now() - slider.value / 1000 * duration * 1e3 : null;
  play.textContent = playing === null ? 'play' : 'pause';
  const step = (now) => {
    if (playing === null) return;
    const time = ((now - playing) / 1e3) % duration;
    slider.value = time / duration * 1000;
    drawArm(Math.max(0, time));
    requestAnimationFrame(step);
  };
  if (playing !== null) requestAnimationFrame(step);
});
slider.addEventListener('input', () => { playing = null; play.textContent = 'play'; showArm(); });
window.addEventListener('resize', showArm);
showArm();
drawAll();
