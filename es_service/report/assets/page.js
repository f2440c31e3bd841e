// What the page does with the numbers it was given: it shows and hides, and computes nothing that is reported.
"use strict";
(() => {
  const given = {}; // newer data than that of the page, from the server of a live page
  const read = (name) => given[name] || JSON.parse(byId("data-" + name)?.textContent || "null");
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const byId = (name) => document.getElementById(name);
  const SVG = "http://www.w3.org/2000/svg";
  const start = {}; // what brings each section to life, at first and after it was replaced
  window.report = { given, read, bytes, byId, start, details: null }; // for replay.js and live.js

  start.curves = () => {
    for (const input of document.querySelectorAll('input[name="x"]')) {
      if (document.body.dataset.x) input.checked = input.value === document.body.dataset.x; // as before it was replaced
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
  };

  let chosen = null; // the cell; a map that is replaced keeps it
  start.map = () => {
    const map = read("map"), section = byId("map");
    if (!map || !section.querySelector("#cell")) return;
    const place = new Map((map.order || []).map((cell, row) => [String(cell), row]));
    const groups = section.querySelectorAll(".path");
    const colours = ["--s0", "--s1", "--s2", "--s3"];
    const shape = (points, name, colour) => {
      const path = document.createElementNS(SVG, "path");
      path.setAttribute("d", points);
      path.setAttribute("class", name);
      if (colour) path.style.stroke = `var(${colour})`;
      return path;
    };
    const show = (cell) => { byId("cell").textContent = `${map.rows[cell][0]}: ${map.rows[cell][1]}`; };
    const draw = (found, cell, row) => {
      byId("command").textContent = typeof found.evaluate === "string" ? found.evaluate : found.evaluate[cell];
      groups.forEach((group) => group.replaceChildren());
      if (row === undefined) {
        byId("cell").textContent += "; its path is damaged or was not read";
        return;
      }
      const paths = new Int16Array(bytes(found.paths));
      const detours = new Map(found.detours[cell]); // from these points, no straight line leads to the next
      for (let line = 0; line < found.lines; line++) {
        const first = 2 * found.points * (row * found.lines + line);
        const point = (k) => `${paths[first + 2 * k] / 10} ${paths[first + 2 * k + 1] / 10}`;
        let points = "", round = "";
        for (let k = 0; k < found.points; k++) points += (k && !detours.has(k - 1) ? "L" : "M") + point(k);
        detours.forEach((way, k) => { if (way) round += `M${point(k)}${way}L${point(k + 1)}`; });
        for (const group of groups) {
          if (map.overlay) group.append(shape(points, "under"), shape(round, "under"), shape(points, "way"), shape(round, "way round"));
          else group.append(shape(points, "way", colours[line]));
        }
      }
    };
    const choose = (cell) => {
      chosen = cell;
      section.querySelectorAll(".outline").forEach((outline) => outline.replaceChildren());
      section.querySelectorAll(`[data-c="${cell}"]`).forEach((one) => {
        const shape = one.cloneNode();
        delete shape.dataset.c;
        one.ownerSVGElement.querySelector(".outline").append(shape);
      });
      show(cell);
      if (!window.report.details) draw(map, cell, place.get(cell));
      else window.report.details(cell).then((found) => {
        if (chosen === cell && document.contains(section)) draw(found, cell, found.order.length ? 0 : undefined);
      });
    };
    const taken = (cell) => {
      choose(cell);
      section.dispatchEvent(new CustomEvent("taken", { bubbles: true, detail: cell }));
    };
    section.addEventListener("pointerover", (event) => { const cell = event.target.dataset.c; if (cell) show(cell); else if (chosen) show(chosen); });
    section.addEventListener("click", (event) => { const cell = event.target.dataset.c; if (cell) taken(cell); });
    // Arrow keys go to the nearest filled cell in their direction, Enter is a click.
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    section.querySelectorAll("svg.map[tabindex]").forEach((svg) => svg.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && chosen) return taken(chosen);
      const way = ways[event.key];
      if (!way) return;
      event.preventDefault();
      const middle = (one) => { const box = one.getBBox(); return [box.x + box.width / 2, box.y + box.height / 2]; };
      const here = svg.querySelector(`[data-c="${chosen}"]`);
      const from = here ? middle(here) : [0, 0];
      let nearest = null, least = Infinity;
      svg.querySelectorAll("[data-c]").forEach((one) => {
        const to = middle(one), along = (to[0] - from[0]) * way[0] + (to[1] - from[1]) * way[1];
        const aside = Math.abs((to[0] - from[0]) * way[1]) + Math.abs((to[1] - from[1]) * way[0]);
        if (along > 0.5 && along + 3 * aside < least) { least = along + 3 * aside; nearest = one.dataset.c; }
      });
      if (nearest) choose(nearest);
    }));
    choose(map.rows[chosen] ? chosen : map.first);
  };

  let until = null; // generations of the slider; none: to the end
  let redraw = () => {};
  start.centres = () => {
    const cloud = read("cloud"), slider = byId("until");
    if (!cloud || !slider) return;
    const x = new Int16Array(bytes(cloud.x)), y = new Int16Array(bytes(cloud.y)), level = new Uint8Array(bytes(cloud.level));
    const canvas = byId("cloud"), pen = canvas.getContext("2d");
    redraw = () => {
      const [shown, text] = cloud.stops[slider.value];
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
    if (until !== null) slider.value = Math.min(until, slider.max);
    slider.addEventListener("input", () => { until = slider.value === slider.max ? null : Number(slider.value); redraw(); });
    redraw();
  };
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => redraw());

  Object.values(start).forEach((begin) => begin());
})();
