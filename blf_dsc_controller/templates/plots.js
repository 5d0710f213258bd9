// SPDX-License-Identifier: Apache-2.0
// Draws the panels from the data of the page; nothing is loaded from elsewhere.
'use strict';

const data = JSON.parse(document.getElementById('data').textContent);
const timePlots = [];
const duration = data.seconds;
let following = false;

// Legends are below: above they would cover the title, beside it take half of a narrow plot.
function legendHeight(panel, width) {
  const names = panel.traces.filter((trace) => trace.showlegend !== false).map((one) => one.name);
  const entry = 45 + 6.5 * Math.max(0, ...names.map((name) => name.length));
  return 19 * Math.ceil(names.length / Math.max(1, Math.floor(width / entry)));
}

// A logarithmic axis shows a decade at least: its ticks would be numbers of many digits.
function rangeOf(panel) {
  const values = panel.traces.flatMap((trace) => trace.y).filter((y) => y > 0);
  const ends = [Math.min, Math.max].map((of) => Math.log10(values.reduce((a, b) => of(a, b), values[0])));
  const room = (1 - (ends[1] - ends[0])) / 2;
  return panel.log && room > 0 ? {range: [ends[0] - room, ends[1] + room]} : {};
}

function layoutOf(panel, width) {
  const legend = legendHeight(panel, width - 110);
  const grid = {gridcolor: '#e5e7eb', zerolinecolor: '#d1d5db'};
  return {
    title: {text: panel.title, x: 0.01, xanchor: 'left', font: {size: 14}},
    height: 270 + legend,
    margin: {l: 62, r: 34, t: 34, b: 46 + legend},
    paper_bgcolor: 'white', plot_bgcolor: 'white',
    legend: {font: {size: 11}, orientation: 'h', x: 0, xanchor: 'left', yref: 'container', y: 0,
      yanchor: 'bottom'},
    modebar: {orientation: 'v'},
    font: {family: 'system-ui, DejaVu Sans, sans-serif', size: 12, color: '#22272e'},
    hovermode: 'x',
    dragmode: 'zoom',
    xaxis: {...grid, title: {text: 'time [s]', standoff: 6}, range: [0, duration]},
    yaxis: {...grid, title: {text: panel.unit, standoff: 4},
      type: panel.log ? 'log' : 'linear', exponentformat: 'power', automargin: true,
      ...rangeOf(panel)},
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

drawAll();
