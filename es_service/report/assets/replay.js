// Replays: the recorded poses, drawn with three.js where the page has WebGL, else the path from above.
"use strict";
const BOTH_SIDES = 2; // of a surface, as three.js numbers them
let endReplay = () => {};
window.report.start.replay = () => {
  endReplay(); // of the replay that this one replaces
  const { read, bytes, byId } = window.report;
  const data = read("replay");
  if (!data || !byId("episode")) return;
  const ended = new AbortController(), { signal } = ended;
  const episodes = data.episodes.map((one) => ({
    ...one,
    way: new Int16Array(bytes(one.way)),
    positions: one.positions && new Uint16Array(bytes(one.positions)),
    rotations: one.rotations && new Int16Array(bytes(one.rotations)),
  }));
  let current = 0, step = 0, playing = false, last = 0;

  const plan = byId("plan"), group = plan.querySelector(".path");
  const SVG = "http://www.w3.org/2000/svg";
  const whole = document.createElementNS(SVG, "path"), dot = document.createElementNS(SVG, "circle");
  whole.setAttribute("class", "way");
  dot.setAttribute("r", 6);
  dot.setAttribute("class", "body");
  group.append(whole, dot);
  const flat = {
    load() {
      const { way } = episodes[current];
      let points = "";
      for (let k = 0; k < way.length; k += 2) points += `${k ? "L" : "M"}${way[k] / 10} ${way[k + 1] / 10}`;
      whole.setAttribute("d", points);
    },
    show() {
      const { way } = episodes[current];
      dot.setAttribute("cx", way[2 * step] / 10);
      dot.setAttribute("cy", way[2 * step + 1] / 10);
    },
  };

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const solid = () => {
    const T = window.THREE, canvas = byId("stage"), box = byId("stage-box");
    const renderer = new T.WebGLRenderer({ canvas, antialias: true });
    const scene = new T.Scene(), camera = new T.PerspectiveCamera(45, 1, 0.08 * data.reach, 1);
    camera.up.set(0, 0, 1);
    const orbit = new T.OrbitControls(camera, canvas);
    if (data.floor !== null) orbit.maxPolarAngle = Math.PI * 0.495;
    const sky = new T.HemisphereLight(0xffffff, 0x8a939c);
    scene.add(sky);
    const sun = new T.DirectionalLight(0xffffff, 1.8);
    sun.position.set(0.5, -1, 2);
    scene.add(sun);
    const colour = (name) => new T.Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim());
    const links = Array.from({ length: data.links }, () => { const link = new T.Group(); scene.add(link); return link; });
    const surfaces = data.meshes.map(({ unit, vertices, triangles }) => {
      const places = Float32Array.from(new Int16Array(bytes(vertices)), (x) => x * unit);
      const surface = new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(places, 3));
      return surface.setIndex([...new Uint32Array(bytes(triangles))]);
    });
    const far = 60 * data.reach; // where a plane without an end seems to end
    const geometry = ({ kind, floor: isFloor, mesh, size: [a, b, c] }) => {
      switch (kind) {
        case "sphere": return new T.SphereGeometry(a, 24, 16);
        case "capsule": return new T.CapsuleGeometry(a, 2 * b, 6, 16).rotateX(Math.PI / 2);
        case "cylinder": return new T.CylinderGeometry(a, a, 2 * b, 24).rotateX(Math.PI / 2);
        case "ellipsoid": return new T.SphereGeometry(1, 24, 16).scale(a, b, c);
        case "box": return new T.BoxGeometry(2 * a, 2 * b, 2 * c);
        case "mesh": return surfaces[mesh];
        default: return isFloor ? null : new T.PlaneGeometry(2 * a || far, 2 * b || far);
      }
    };
    for (const shape of data.shapes) {
      const form = geometry(shape);
      if (!form) continue; // the floor is drawn below, as large as the path
      const facets = shape.kind === "mesh" || shape.kind === "plane"; // without normals, and open
      const [red, green, blue, opacity] = shape.colour;
      const mesh = new T.Mesh(form, new T.MeshLambertMaterial({ color: new T.Color(red, green, blue).convertSRGBToLinear(), opacity, transparent: opacity < 1, flatShading: facets, side: facets ? BOTH_SIDES : 0 }));
      const [w, x, y, z] = shape.rotation;
      mesh.quaternion.set(x, y, z, w);
      mesh.position.set(...shape.position);
      (shape.link < 0 ? scene : links[shape.link]).add(mesh);
    }
    if (data.goal) {
      const radius = data.goal_radius, height = 0.1 * radius;
      const goal = new T.Mesh(new T.CylinderGeometry(radius, radius, height, 32).rotateX(Math.PI / 2), new T.MeshLambertMaterial({ color: colour("--goal") }));
      goal.position.set(data.goal[0], data.goal[1], data.ground + 0.5 * height);
      scene.add(goal);
    }
    const floor = new T.Mesh(new T.PlaneGeometry(1, 1), new T.MeshLambertMaterial({ polygonOffset: true, polygonOffsetFactor: 4, polygonOffsetUnits: 4 }));
    floor.position.z = data.ground - 0.004 * data.reach;
    if (data.floor !== null) scene.add(floor);
    let grid = null, path = null;
    const place = (k, link, target) => {
      const { positions, low, size } = episodes[current], first = 3 * (k * data.links + link);
      return target.set(...[0, 1, 2].map((axis) => low[axis] + positions[first + axis] * size[axis]));
    };
    const at = new T.Vector3(), before = new T.Vector3(), middle = new T.Vector3();
    const line = (points, name) => new T.Line(
      new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(points.flat(), 3)),
      new T.LineBasicMaterial({ color: colour(name) }),
    );
    const dress = () => {
      scene.background = colour("--ground");
      floor.material.color = colour("--paper");
      sky.intensity = dark.matches ? 4 : 2.2; // bodies are often dark
    };
    const aim = () => { // from the south and above; near enough to see the body, or the whole path
      const { low, size } = episodes[current];
      const width = Math.max(65535 * size[0], 65535 * size[1]);
      const away = Math.max(4 * data.reach, byId("follow").checked ? 0 : 1.25 * width) * Math.max(1, 1.4 * box.clientHeight / box.clientWidth);
      if (byId("follow").checked) place(step, data.followed, middle);
      else middle.set(low[0] + 32767 * size[0], low[1] + 32767 * size[1], data.ground);
      orbit.target.copy(middle);
      camera.position.set(middle.x - 0.25 * away, middle.y - 0.85 * away, middle.z + 0.7 * away);
    };
    return {
      load() {
        const { steps, low, size } = episodes[current];
        if (path) for (const old of [path, grid]) { scene.remove(old); old.geometry.dispose(); old.material.dispose(); }
        const points = [];
        for (let k = 0; k <= steps; k++) { place(k, data.followed, at); points.push([at.x, at.y, data.ground + 0.016 * data.reach]); }
        path = line(points, "--goal");
        const unit = 10 ** Math.round(Math.log10(data.reach)); // a metre for a robot of that size
        const extent = Math.max(20 * unit, 65535 * size[0], 65535 * size[1], 90 * unit * (data.goal ? 1 : 0));
        const square = extent <= 30 * unit ? unit : 5 * unit, half = Math.ceil(extent / square), corners = [];
        camera.far = 20 * extent;
        floor.scale.set(4 * half * square, 4 * half * square, 1);
        floor.position.x = low[0] + 32767 * size[0];
        floor.position.y = low[1] + 32767 * size[1];
        // To and fro from corner to corner: of long lines with an end behind the camera, some renderers draw nothing.
        for (let i = -half; i <= half; i++) {
          for (let j = -half; j <= half; j++) corners.push([i * square, ((i + half) % 2 ? -j : j) * square, 0]);
        }
        for (let j = half; j >= -half; j--) {
          for (let i = half; i >= -half; i--) corners.push([((half - j) % 2 ? -i : i) * square, j * square, 0]);
        }
        grid = line(corners, "--line");
        grid.position.set(unit * Math.round(floor.position.x / unit), unit * Math.round(floor.position.y / unit), data.ground);
        scene.add(path, grid);
        place(0, data.followed, before);
        aim();
      },
      aim,
      show() {
        const { rotations } = episodes[current];
        links.forEach((link, number) => {
          place(step, number, link.position);
          const first = 4 * (step * data.links + number);
          link.quaternion.set(rotations[first + 1], rotations[first + 2], rotations[first + 3], rotations[first]).normalize();
        });
        place(step, data.followed, at);
        if (byId("follow").checked) {
          camera.position.add(at).sub(before);
          orbit.target.copy(at);
        }
        before.copy(at);
        orbit.update();
        this.draw();
      },
      draw() {
        const { width, height } = box.getBoundingClientRect();
        renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
        renderer.setSize(width, height, false);
        camera.aspect = width / height;
        camera.updateProjectionMatrix();
        dress();
        renderer.render(scene, camera);
        canvas.dataset.triangles = renderer.info.render.triangles;
      },
      listen(draw) { orbit.addEventListener("change", draw); },
      end() { orbit.dispose(); renderer.dispose(); renderer.forceContextLoss(); }, // a page has few contexts
    };
  };

  let view = flat;
  if (data.solid) {
    let possible = null;
    try { possible = document.createElement("canvas").getContext("webgl2"); } catch { /* then there is none */ }
    if (possible) view = solid();
    else {
      byId("stage-box").hidden = true;
      plan.hidden = false;
      byId("follow").disabled = true;
    }
  }
  const scrub = byId("scrub"), play = byId("play");
  const show = () => {
    const { steps, returns } = episodes[current];
    step = Math.min(step, steps);
    scrub.value = step;
    byId("step").textContent = `step ${Math.floor(step)} of ${steps}; return so far ${returns[Math.floor(step)]}`;
    view.show();
  };
  const load = () => {
    current = Number(byId("episode").value);
    step = 0;
    scrub.max = episodes[current].steps;
    document.querySelectorAll("#replay .episode").forEach((note, number) => { note.hidden = number !== current; });
    view.load();
    show();
  };
  const stop = () => { playing = false; play.textContent = "Play"; };
  let exact = 0;
  const tick = (now) => {
    if (!playing) return;
    exact += Math.max(0, now - last) / 1000 / data.step_s * Number(byId("speed").value);  // the time of a frame may be before the click
    last = now;
    step = Math.min(Math.floor(exact), episodes[current].steps);
    show();
    if (step >= episodes[current].steps) stop();
    else requestAnimationFrame(tick);
  };
  play.addEventListener("click", () => {
    if (playing) return stop();
    if (step >= episodes[current].steps) step = 0;
    playing = true;
    play.textContent = "Pause";
    exact = step;
    last = performance.now();
    requestAnimationFrame(tick);
  });
  scrub.addEventListener("input", () => { step = Number(scrub.value); exact = step; show(); });
  byId("episode").addEventListener("change", () => { stop(); load(); });
  byId("follow")?.addEventListener("change", () => { if (view.aim) { view.aim(); show(); } });
  window.addEventListener("resize", show, { signal });
  dark.addEventListener("change", show, { signal });
  load();
  view.listen?.(() => view.draw());
  endReplay = () => { stop(); ended.abort(); view.end?.(); };
};
window.addEventListener("DOMContentLoaded", window.report.start.replay);
