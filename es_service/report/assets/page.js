// What the page does with the numbers it was given: it shows and hides, and computes nothing that is reported.
"use strict";
(() => {
  const read = (name) => { const found = document.getElementById("data-" + name); return found && JSON.parse(found.textContent); };
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const byId = (name) => document.getElementById(name);
  const SVG = "http://www.w3.org/2000/svg";
  window.report = { read, bytes, byId }; // for replay.js

  for (const input of document.querySelectorAll('input[name="x"]')) {
    const choose = () => { if (input.checked) document.body.dataset.x = input.value; };
    input.addEventListener("change", choose);
    choose(); // a reloaded page keeps what was chosen
  }

  const charts = read("charts");
  if (charts) document.querySelectorAll(".charts > .chart").forEach((figure, number) => {
    const { axes, texts } = charts[number];
    figure.addEventListener("pointermove", (event) => {
      const axis = document.body.dataset.x || "generation";
      const plot = figure.querySelector(".x-" + axis);
      const box = plot.getBoundingClientRect();
      const x = (event.clientX - box.left) / box.width * plot.viewBox.baseVal.width;
      let nearest = 0;
      axes[axis].forEach((place, k) => { if (Math.abs(place - x) < Math.abs(axes[axis][nearest] - x)) nearest = k; });
      const line = plot.querySelector(".pointer");
      line.setAttribute("x1", axes[axis][nearest]);
      line.setAttribute("x2", axes[axis][nearest]);
      line.style.display = "inline";
      let text = figure.querySelector(".at");
      if (!text) {
        text = document.createElement("div");
        text.className = "at readout note";
        figure.append(text);
      }
      text.textContent = (texts[axis] || texts[""])[nearest];
    });
  });

  const map = read("map");
  if (map) {
    const paths = new Int16Array(bytes(map.paths));
    const place = new Map(map.order.map((cell, row) => [String(cell), row]));
    const groups = document.querySelectorAll("#map .path");
    const colours = ["--s0", "--s1", "--s2", "--s3"];
    const shape = (points, name, colour) => {
      const path = document.createElementNS(SVG, "path");
      path.setAttribute("d", points);
      path.setAttribute("class", name);
      if (colour) path.style.stroke = `var(${colour})`;
      return path;
    };
    const show = (cell) => { byId("cell").textContent = `${map.rows[cell][0]}: ${map.rows[cell][1]}`; };
    let chosen = null;
    const choose = (cell) => {
      chosen = cell;
      document.querySelectorAll(".outline").forEach((outline) => outline.replaceChildren());
      document.querySelectorAll(`[data-c="${cell}"]`).forEach((one) => {
        const shape = one.cloneNode();
        delete shape.dataset.c;
        one.ownerSVGElement.querySelector(".outline").append(shape);
      });
      show(cell);
      byId("command").textContent = map.evaluate[cell];
      groups.forEach((group) => group.replaceChildren());
      const row = place.get(cell);
      if (row === undefined) {
        byId("cell").textContent += "; its path is damaged or was not read";
        return;
      }
      const detours = new Map(map.detours[cell]); // from these points, no straight line leads to the next
      for (let line = 0; line < map.lines; line++) {
        const first = 2 * map.points * (row * map.lines + line);
        const point = (k) => `${paths[first + 2 * k] / 10} ${paths[first + 2 * k + 1] / 10}`;
        let points = "", round = "";
        for (let k = 0; k < map.points; k++) points += (k && !detours.has(k - 1) ? "L" : "M") + point(k);
        detours.forEach((way, k) => { if (way) round += `M${point(k)}${way}L${point(k + 1)}`; });
        for (const group of groups) {
          if (map.overlay) group.append(shape(points, "under"), shape(round, "under"), shape(points, "way"), shape(round, "way round"));
          else group.append(shape(points, "way", colours[line]));
        }
      }
    };
    byId("map").addEventListener("pointerover", (event) => { const cell = event.target.dataset.c; if (cell) show(cell); else if (chosen) show(chosen); });
    byId("map").addEventListener("click", (event) => { const cell = event.target.dataset.c; if (cell) choose(cell); });
    choose(map.first);
  }

  const cloud = read("cloud");
  if (cloud) {
    const x = new Int16Array(bytes(cloud.x)), y = new Int16Array(bytes(cloud.y)), level = new Uint8Array(bytes(cloud.level));
    const canvas = byId("cloud"), pen = canvas.getContext("2d");
    const draw = () => {
      const [shown, text] = cloud.stops[byId("until").value];
      byId("until-text").textContent = text;
      pen.clearRect(0, 0, canvas.width, canvas.height);
      const side = shown > 5000 ? 5 : 7;
      const edge = getComputedStyle(document.documentElement).getPropertyValue("--edge");
      for (let k = 0; k < shown; k++) { // an edge, since the ends of the scale are like a dark or a light ground
        const left = x[k] / 5 - side / 2, top = y[k] / 5 - side / 2; // tenths of a pixel on two per pixel
        pen.fillStyle = edge;
        pen.fillRect(left - 1, top - 1, side + 2, side + 2);
        pen.fillStyle = cloud.colours[level[k]];
        pen.fillRect(left, top, side, side);
      }
    };
    byId("until").addEventListener("input", draw);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    draw();
  }
})();
