"use strict";
(() => {
  const { Viewer, THREE } = MeshCat;
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const panel = document.getElementById("panel");

  // --- what the scene is packed in -------------------------------------------------------------------------------
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const floats = (text) => new Float32Array(bytes(text));
  const integers = (text) => new Uint32Array(bytes(text));
  // Matrices stand row by row, one or many in one text.
  const matrices = (text) => {
    const all = floats(text);
    return Array.from({ length: all.length / 16 }, (_, i) => new THREE.Matrix4().set(...all.subarray(16 * i, 16 * i + 16)));
  };
  const matrix = (text) => matrices(text)[0];
  const lower = floats(scene.lower), upper = floats(scene.upper), start = floats(scene.q);
  const prismatic = scene.kinematics.types.map((kind) => kind === "prismatic");

  const poses = new Map(
    scene.fields.poses.map((part) => {
      const q = floats(part.q);
      const unpacked = { name: part.name, q, count: q.length / scene.joints.length };
      if (part.lines) unpacked.lines = integers(part.lines);
      if (part.held_out) unpacked.held = integers(part.held_out);
      if (part.position) unpacked.points = floats(part.position);
      return [part.name, unpacked];
    }),
  );

  // --- names: whatever a file calls its joints, they are text, and each has a place of its own in the tree ----------
  const taken = new Map();
  function place(folder, name) {
    // A slash parts levels of the tree; and some names mean something to every object of the language.
    let clean = String(name).replaceAll("/", "\u2215") || "(no name)";
    if (clean in {}) clean += " ";
    const names = taken.get(folder) || new Set();
    taken.set(folder, names);
    while (names.has(clean)) clean += " again";
    names.add(clean);
    return [folder, clean];
  }

  function element(tag, properties = {}, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  }

  let viewer;
  try {
    viewer = new Viewer(document.getElementById("view"));
  } catch (error) {
    document.getElementById("view").append(
      element("p", { id: "message", textContent: `This page needs WebGL, which this browser does not support (${error.message}).` }),
    );
    return;
  }
  const node = (path) => viewer.scene_tree.find(path);
  // The picture fills its part of the page: beside the panel, on a phone above it.
  const view = document.getElementById("view"), resize = viewer.set_3d_pane_size.bind(viewer);
  viewer.set_3d_pane_size = () => resize(view.clientWidth, view.clientHeight);
  viewer.set_3d_pane_size();

  // --- lengths in words ----------------------------------------------------------------------------------------
  function digits(value) {
    if (value === 0) return "0";
    const places = Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value))));
    return value.toFixed(Math.min(places, 6)).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, "");
  }
  const lengthUnit = (top) => (top < 1e-4 ? [1e6, "\u00b5m"] : [1e3, "mm"]);
  function inWords(length) {
    const [factor, unit] = lengthUnit(length);
    return `${digits(length * factor)} ${unit}`;
  }
  const factorWords = (factor) => `\u00d7${factor >= 100 ? Math.round(factor).toLocaleString("en") : digits(factor)}`;
  function roundDown(value) {
    const power = 10 ** Math.floor(Math.log10(value) + 1e-9);
    return power * [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9));
  }

  // --- the robot -----------------------------------------------------------------------------------------------
  const moving = []; // {path, body, placement}: what setPose moves
  function buildRobot() {
    const links = new Map();
    for (const shape of scene.shapes) {
      const key = `${shape.body} ${shape.link}`;
      if (!links.has(key)) links.set(key, { path: place("robot", shape.link), body: shape.body, group: new THREE.Group() });
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(floats(shape.vertices), 3));
      geometry.setIndex(new THREE.BufferAttribute(integers(shape.faces), 1));
      geometry.computeVertexNormals();
      const material = new THREE.MeshPhongMaterial({
        color: new THREE.Color(...shape.colour), flatShading: true, side: THREE.DoubleSide, shininess: 12,
      });
      links.get(key).group.add(new THREE.Mesh(geometry, material));
    }
    for (const link of links.values()) {
      viewer.set_object(link.path, link.group);
      moving.push({ path: link.path, body: link.body, placement: new THREE.Matrix4() });
    }
  }

  const base = matrix(scene.T_scene_base), first = base.clone().multiply(matrix(scene.kinematics.first));
  const before = matrices(scene.kinematics.before), after = matrices(scene.kinematics.after);
  function linkFrames(q) {
    // frames[0] is where the first axis stands, frames[i] moves with joint i.
    const frames = [first.clone()];
    q.forEach((value, i) => {
      const moved = new THREE.Matrix4();
      if (prismatic[i]) moved.makeTranslation(0, 0, value);
      else moved.makeRotationZ(value);
      frames.push(frames[i].clone().multiply(before[i]).multiply(moved).multiply(after[i]));
    });
    return frames;
  }

  let pose = Array.from(start);
  function setPose(q) {
    pose = Array.from(q);
    const frames = linkFrames(pose);
    for (const { path, body, placement, fromFirst } of moving) {
      const frame = body === 0 && !fromFirst ? base : frames[body];
      viewer.set_transform(path, frame.clone().multiply(placement).elements);
    }
    sliders.forEach((slider, i) => slider.show(pose[i]));
    viewer.set_dirty();
  }

  // --- labels: text over the picture, placed so that none covers another and none is cut ----------------------------
  // The smaller the rank, the sooner a label has its place; what finds none is not shown.
  const RANKS = { frame: 0, joint: 1, letter: 2 };
  const labels = [];
  const overlay = view.appendChild(element("div", { id: "labels" }));
  function label(text, rank, colour) {
    const shown = text.length > 40 ? `${text.slice(0, 39)}\u2026` : text;
    const box = overlay.appendChild(element("span", { className: rank, textContent: shown }));
    if (colour) box.style.color = colour;
    const anchor = new THREE.Object3D();
    labels.push({ anchor, box, rank: RANKS[rank], place: 0 });
    return anchor;
  }

  // Places about an anchor, from the one that reads best: parts of the label's width and height between the anchor and
  // its left upper corner, and how far to go in each direction [px].
  const GAP = 5, STEP = 17;
  const PLACES = [0, STEP, 2 * STEP].flatMap((more) => [
    [0, -0.5, GAP + more, 0], [0, -1, GAP, -more], [0, 0, GAP, more], [-1, -0.5, -GAP - more, 0],
    [-1, -1, -GAP, -more], [-1, 0, -GAP, more], [-0.5, -1, 0, -GAP - more], [-0.5, 0, 0, GAP + more],
  ]);
  function placed(one, at, k) {
    const [across, down, right, below] = PLACES[k];
    const left = at.x + across * one.width + right, upper = at.y + down * one.height + below;
    return { left, upper, right: left + one.width, lower: upper + one.height };
  }
  const isShown = (object) => !object || (object.visible && isShown(object.parent));
  function onScreen(one, point) {
    // Where the anchor is in the picture [px]; null if nothing of it is seen.
    if (!isShown(one.anchor)) return null;
    point.setFromMatrixPosition(one.anchor.matrixWorld).project(viewer.camera);
    if (Math.abs(point.x) > 1 || Math.abs(point.y) > 1 || Math.abs(point.z) > 1) return null;
    return { x: (0.5 + 0.5 * point.x) * view.clientWidth, y: (0.5 - 0.5 * point.y) * view.clientHeight };
  }
  function placeLabels() {
    const width = view.clientWidth, height = view.clientHeight, taken = [], point = new THREE.Vector3();
    const isFree = (box) =>
      box.left >= 2 && box.upper >= 2 && box.right <= width - 2 && box.lower <= height - 2 &&
      taken.every((other) => box.left > other.right || box.right < other.left || box.upper > other.lower || box.lower < other.upper);
    for (const one of labels) {
      const at = onScreen(one, point);
      // What had a place keeps it while it is free, so that labels do not jump about as the picture turns.
      const order = [one.place, ...PLACES.keys()];
      const k = at ? order.find((index) => isFree(placed(one, at, index))) : undefined;
      one.box.style.visibility = k === undefined ? "hidden" : "visible";
      if (k === undefined) continue;
      const box = placed(one, at, k);
      one.place = k;
      taken.push(box);
      one.box.style.transform = `translate(${box.left}px, ${box.upper}px)`;
    }
  }
  function beginLabels() {
    labels.sort((one, other) => one.rank - other.rank);
    for (const one of labels) {
      const { width, height } = one.box.getBoundingClientRect();
      one.width = Math.ceil(width);
      one.height = Math.ceil(height);
    }
    const draw = viewer.render.bind(viewer);
    viewer.render = () => {
      draw();
      placeLabels();
    };
  }

  // --- frames and axes -----------------------------------------------------------------------------------------
  function rod(start, end, radius, colour) {
    const way = new THREE.Vector3().subVectors(end, start);
    const geometry = new THREE.CylinderGeometry(radius, radius, way.length(), 10);
    const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color: colour }));
    mesh.position.addVectors(start, end).multiplyScalar(0.5);
    mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), way.normalize());
    return mesh;
  }

  // Colours that are distinguished by every eye (Okabe and Ito).
  const TRIAD = [["x", "#e36b2c"], ["y", "#1fb58f"], ["z", "#56b4e9"]];
  function buildFrames() {
    const size = 0.13 * scene.reach;
    for (const frame of scene.frames) {
      const path = place("frames", frame.name);
      const group = new THREE.Group();
      TRIAD.forEach(([name, colour], i) => {
        const end = new THREE.Vector3().setComponent(i, size);
        group.add(rod(new THREE.Vector3(), end, 0.022 * size, colour));
        const letter = label(name, "letter", colour);
        letter.position.copy(end).multiplyScalar(1.06);
        group.add(letter);
      });
      const title = label(frame.name, "frame");
      title.position.setScalar(-0.1 * size);
      group.add(title);
      viewer.set_object(path, group);
      const placement = matrix(frame.placement);
      if (frame.body === 0) viewer.set_transform(path, placement.elements);
      else moving.push({ path, body: frame.body, placement });
    }
  }

  const NOMINAL = "#7d8a9b", ACTUAL = "#ffffff";
  function buildAxes() {
    const radius = 0.0022 * scene.reach;
    scene.axes.forEach((axis, i) => {
      const path = place("axes", axis.joint);
      const group = new THREE.Group();
      const ends = (pair) => [0, 3].map((k) => new THREE.Vector3().fromArray(floats(pair), k));
      group.add(rod(...ends(axis.nominal), radius, NOMINAL));
      group.add(rod(...ends(axis.actual), 1.25 * radius, ACTUAL));
      const name = label(axis.joint, "joint");
      name.position.copy(ends(axis.actual)[1]);
      group.add(name);
      viewer.set_object(path, group);
      moving.push({ path, body: i, placement: new THREE.Matrix4(), fromFirst: true });
    });
  }

  // --- arrows: one object a layer, however many there are ----------------------------------------------------------
  function arrowGeometry() {
    // Along z from 0 to 1, a shaft of diameter 1 with three sides and a head of four: ten triangles, for there are many.
    const ring = (sides, radius, z) =>
      Array.from({ length: sides }, (_, i) => {
        const angle = (2 * Math.PI * i) / sides;
        return [radius * Math.cos(angle), radius * Math.sin(angle), z];
      });
    const corners = [];
    const low = ring(3, 0.55, 0), high = ring(3, 0.55, 0.7), brim = ring(4, 1.6, 0.66), tip = [0, 0, 1];
    for (let i = 0; i < 3; i++) {
      const j = (i + 1) % 3;
      corners.push(low[i], low[j], high[j], low[i], high[j], high[i]);
    }
    for (let i = 0; i < 4; i++) corners.push(brim[i], brim[(i + 1) % 4], tip);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners.flat()), 3));
    return geometry;
  }

  // Viridis without its dark end, which would be indistinguishable from the background: steps of equal lightness, for every eye.
  const COLOURS = ["#375a8c", "#2d718e", "#24868e", "#1e9c89", "#2cb17e", "#52c569", "#86d549", "#c2df23", "#fde725"];
  const stops = COLOURS.map((code) => new THREE.Color(code));
  function colourOf(part, out) {
    const at = Math.min(Math.max(part, 0), 1) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    return out.copy(stops[low]).lerp(stops[low + 1], at - low);
  }

  // The more there are, the thinner each.
  const slender = (count) => Math.min(1, Math.max(0.45, (1000 / count) ** (1 / 3)));
  const layers = [];
  // A scale that ends at a number of two digits.
  function scaleEnd(layer) {
    if (!(layer.covered > 0)) return 1e-9;
    const step = 10 ** (Math.floor(Math.log10(layer.covered)) - 1);
    return Math.ceil(layer.covered / step - 1e-9) * step;
  }
  // Part of the arrows of a layer that the colour scale covers; the few largest share its last colour.
  const COVERED = 0.99;
  function quantile(sizes, part) {
    const sorted = sizes.slice().sort(), at = part * (sorted.length - 1), low = Math.floor(at);
    return sorted[low] + (at - low) * (sorted[Math.ceil(at)] - sorted[low]);
  }
  let factor = scene.scale, top = 1e-9;
  function buildLayers() {
    const geometry = arrowGeometry();
    scene.fields.layers.forEach((given, index) => {
      const cut = given.name.indexOf("/");
      const path = place(given.name.slice(0, cut), given.name.slice(cut + 1));
      const points = floats(given.points), vectors = floats(given.vectors);
      const count = points.length / 3;
      const mesh = new THREE.InstancedMesh(geometry, new THREE.MeshBasicMaterial({ side: THREE.DoubleSide }), count);
      mesh.instanceColor = new THREE.InstancedBufferAttribute(new Float32Array(3 * count), 3);
      // Its bounds would be those of one arrow.
      mesh.frustumCulled = false;
      const sizes = new Float32Array(count);
      for (let i = 0; i < count; i++) sizes[i] = Math.hypot(vectors[3 * i], vectors[3 * i + 1], vectors[3 * i + 2]);
      const mean = sizes.reduce((sum, size) => sum + size, 0) / count;
      const layer = {
        ...given, path, points, vectors, sizes, mesh, count, mean,
        largest: quantile(sizes, 1), covered: quantile(sizes, COVERED), drawn: false,
      };
      mesh.userData.layer = layer;
      viewer.set_object(path, mesh);
      viewer.set_property(path, "visible", index === 0);
      layers.push(layer);
    });
    top = scaleEnd(layers[0]);
  }

  function fill(layer) {
    // Column by column: two directions across the arrow, the way along it, its tail.
    const { mesh, points, vectors, sizes, count } = layer;
    const out = mesh.instanceMatrix.array, colours = mesh.instanceColor.array;
    const widest = 0.0042 * scene.reach * slender(count), colour = new THREE.Color();
    for (let i = 0; i < count; i++) {
      const length = Math.max(sizes[i] * factor, 1e-6);
      const width = Math.min(widest, 0.16 * length);
      const x = sizes[i] ? vectors[3 * i] / sizes[i] : 0, y = sizes[i] ? vectors[3 * i + 1] / sizes[i] : 0;
      const z = sizes[i] ? vectors[3 * i + 2] / sizes[i] : 1;
      const sign = z >= 0 ? 1 : -1, a = -1 / (sign + z), b = x * y * a;
      const k = 16 * i;
      out[k] = width * (1 + sign * x * x * a); out[k + 1] = width * sign * b; out[k + 2] = -width * sign * x; out[k + 3] = 0;
      out[k + 4] = width * b; out[k + 5] = width * (sign + y * y * a); out[k + 6] = -width * y; out[k + 7] = 0;
      out[k + 8] = length * x; out[k + 9] = length * y; out[k + 10] = length * z; out[k + 11] = 0;
      out[k + 12] = points[3 * i]; out[k + 13] = points[3 * i + 1]; out[k + 14] = points[3 * i + 2]; out[k + 15] = 1;
      colourOf(sizes[i] / top, colour).toArray(colours, 3 * i);
    }
    mesh.instanceMatrix.needsUpdate = true;
    mesh.instanceColor.needsUpdate = true;
    layer.drawn = true;
  }

  function redraw() {
    for (const layer of layers) {
      layer.drawn = false;
      if (node(layer.path).object.visible) fill(layer);
    }
    viewer.set_dirty();
  }

  // --- measured points -----------------------------------------------------------------------------------------
  const MEASURED = "#d7dde5", HELD = "#ff7eb6";
  const marks = [];
  function buildPoints() {
    const part = poses.get("measured");
    if (!part || !part.points) return;
    const rows = Array.from({ length: part.count }, (_, i) => i);
    const held = rows.filter((i) => part.held && part.held[i]);
    const seen = rows.filter((i) => !(part.held && part.held[i]));
    const size = 0.0055 * scene.reach * slender(part.count);
    const small = seen.length > 2000 ? new THREE.TetrahedronGeometry(1.2 * size) : new THREE.IcosahedronGeometry(size);
    mark("measured", seen, part, small, MEASURED, "disc");
    mark("held out", held, part, new THREE.OctahedronGeometry(1.9 * size), HELD, "diamond");
  }
  function mark(name, rows, part, geometry, colour, kind) {
    const path = place("points", name);
    const mesh = new THREE.InstancedMesh(geometry, new THREE.MeshBasicMaterial({ color: colour }), rows.length);
    const at = new THREE.Matrix4();
    rows.forEach((row, i) => mesh.setMatrixAt(i, at.makeTranslation(...part.points.subarray(3 * row, 3 * row + 3))));
    mesh.frustumCulled = false;
    mesh.userData.rows = rows;
    viewer.set_object(path, mesh);
    marks.push({ name, path, mesh, colour, kind, count: rows.length });
  }

  // --- the panel -----------------------------------------------------------------------------------------------
  const boxes = [];
  function toggle(path, words, { number = "", hint = "", swatch = null } = {}) {
    const box = element("input", { type: "checkbox", checked: node(path).object.visible });
    box.addEventListener("change", () => {
      viewer.set_property(path, "visible", box.checked);
      follow();
      viewer.set_dirty();
    });
    boxes.push({ box, path });
    const row = element("label", { className: "row", title: hint }, box);
    if (swatch) row.append(swatch);
    row.append(element("span", { textContent: words }));
    if (number) row.append(element("span", { className: "number", textContent: number }));
    return row;
  }
  // The control tree of the viewer switches the same objects: the boxes follow, and layers are drawn when first shown.
  function follow() {
    for (const { box, path } of boxes) box.checked = node(path).object.visible;
    for (const layer of layers) {
      if (!layer.drawn && node(layer.path).object.visible) {
        fill(layer);
        viewer.set_dirty();
      }
    }
  }

  const heading = (text) => element("h2", { textContent: text });
  const swatch = (colour, kind) => {
    const made = element("i", { className: `mark ${kind}` });
    made.style.background = colour;
    return made;
  };

  let showLegend = () => {};
  function buildLegend() {
    const bar = element("div", { id: "bar" });
    bar.style.background = `linear-gradient(to right, ${COLOURS.join(", ")})`;
    const ticks = element("div", { id: "ticks" });
    const shown = element("output", { id: "factor" });
    const slider = element("input", { type: "range", min: -2, max: 2, step: 0.01, value: 0 });
    slider.setAttribute("aria-label", "factor of the arrows' length");
    const measure = element("p", { className: "quiet" });
    let middle = factor;
    slider.addEventListener("input", () => {
      const value = middle * 10 ** Number(slider.value);
      factor = Number(slider.value) === 0 ? middle : Number(value.toPrecision(2));
      showLegend();
      redraw();
    });
    const choice = element("select", { id: "fit" });
    choice.setAttribute("aria-label", "layer that colours and lengths are scaled to");
    layers.forEach((layer, i) => choice.append(element("option", { value: i, textContent: layer.name })));
    choice.addEventListener("change", () => {
      const layer = layers[Number(choice.value)];
      top = scaleEnd(layer);
      middle = factor = layer.covered > 0 ? roundDown((0.14 * scene.reach) / layer.covered) : 1;
      slider.value = 0;
      showLegend();
      redraw();
    });
    showLegend = () => {
      const [unit, name] = lengthUnit(top);
      // The end has two digits, so half of it is exact with three.
      const tick = (part) => element("span", { textContent: digits(part * top * unit) });
      ticks.replaceChildren(...[0, 0.5, 1].map(tick));
      ticks.lastChild.textContent = `\u2265 ${ticks.lastChild.textContent} ${name}`;
      shown.textContent = factorWords(factor);
      measure.textContent = `10 cm in the view are ${inWords(Number((0.1 / factor).toPrecision(2)))} of deviation`;
    };
    panel.append(
      heading("Size of a deviation"), bar, ticks,
      element("div", { className: "line" }, element("span", { textContent: "arrow scale factor" }), shown),
      slider, measure,
      element("p", { className: "quiet", textContent: "colours and lengths scaled to" }), choice,
    );
    showLegend();
  }

  function buildLayerRows() {
    const folders = { deviations: "Over the measured poses: mean, largest", workspace: "Over the workspace: mean, largest" };
    const groups = new Map();
    for (const layer of layers) {
      const folder = layer.path[0];
      if (!groups.has(folder)) {
        // Measurements are what matters where there are any.
        groups.set(folder, element("details", { open: !groups.size }, element("summary", {}, heading(folders[folder]))));
        panel.append(groups.get(folder));
      }
      // One unit for all of a column; digits as its own size has them.
      const [unit, name] = lengthUnit(Math.max(...layers.map((one) => one.largest)));
      const places = layer.largest > 0 ? Math.min(4, Math.max(0, 2 - Math.floor(Math.log10(layer.largest * unit)))) : 0;
      const number = `${(layer.mean * unit).toFixed(places)}, ${(layer.largest * unit).toFixed(places)} ${name}`;
      groups.get(folder).append(toggle(layer.path, layer.path[1], { number, hint: layer.words }));
    }
    panel.append(heading("Also shown"));
    for (const one of marks) {
      panel.append(toggle(one.path, `${one.name} points`, { number: String(one.count), swatch: swatch(one.colour, one.kind) }));
    }
    panel.append(toggle(["robot"], "robot"), toggle(["frames"], "frames: base, instrument, tool"));
    panel.append(toggle(["axes"], "axes of the joints", { number: factorWords(scene.axis_scale) }));
    panel.append(
      element("p", { className: "quiet" },
        swatch(NOMINAL, ""), ` nominal axis, `, swatch(ACTUAL, ""),
        ` actual axis, its tilt and offset ${factorWords(scene.axis_scale)}`),
    );
  }

  const sliders = [];
  let current = null, playing = null, sayRow = () => {};
  function buildPoseRows() {
    const shown = element("p", { id: "row" });
    const slider = element("input", { id: "pose", type: "range", min: 0, step: 1, value: 0 });
    slider.setAttribute("aria-label", "pose");
    const play = element("button", { id: "play", textContent: "Play", type: "button" });
    const choice = element("select");
    choice.setAttribute("aria-label", "poses of the slider");
    for (const part of poses.values()) {
      choice.append(element("option", { value: part.name, textContent: `${part.name}: ${part.count} poses` }));
    }
    const rowOf = (part, i) => Array.from(part.q.subarray(scene.joints.length * i, scene.joints.length * (i + 1)));
    const use = (name) => {
      current = poses.get(name);
      choice.value = name;
      slider.max = current.count - 1;
    };
    sayRow = (i) => {
      const words = [`pose ${i + 1} of ${current.count}`];
      if (current.lines) words.push(`line ${current.lines[i]}`);
      if (current.held) words.push(current.held[i] ? "held out" : "fitted");
      for (const layer of layers) {
        if (layer.poses === current.name && node(layer.path).object.visible) words.push(`${layer.path[1]} ${inWords(layer.sizes[i])}`);
      }
      shown.textContent = words.join(", ");
    };
    const go = (name, i) => {
      if (!current || current.name !== name) use(name);
      slider.value = i;
      setPose(rowOf(current, i));
      sayRow(i);
    };
    const stop = () => {
      cancelAnimationFrame(playing);
      playing = null;
      play.textContent = "Play";
    };
    play.addEventListener("click", () => {
      if (playing !== null) return stop();
      play.textContent = "Pause";
      let row = Number(slider.value), since = null;
      const step = (now) => {
        since = since === null ? now : since;
        const part = Math.min((now - since) / 900, 1);
        const next = (row + 1) % current.count;
        const from = rowOf(current, row), to = rowOf(current, next);
        // Slow at both ends of every move.
        const eased = part * part * (3 - 2 * part);
        setPose(from.map((value, i) => value + eased * (to[i] - value)));
        if (part === 1) {
          row = next;
          since = now;
          slider.value = row;
          sayRow(row);
        }
        playing = requestAnimationFrame(step);
      };
      playing = requestAnimationFrame(step);
    });
    slider.addEventListener("input", () => {
      stop();
      go(current.name, Number(slider.value));
    });
    choice.addEventListener("change", () => {
      stop();
      go(choice.value, 0);
    });
    panel.append(heading("Pose of the robot"), choice, slider, element("div", { className: "line" }, play, shown));
    const joints = element("details", {}, element("summary", {}, heading("Joints")));
    scene.joints.forEach((name, i) => joints.append(jointRow(name, i, stop, shown)));
    panel.append(joints);
    panel.append(element("p", { className: "quiet", textContent: "Click an arrow or a point to see the robot there." }));
    use(scene.fields.poses[0].name);
    // The pose to begin with is mostly one of the rows.
    const near = (value, i, row) => Math.abs(value - current.q[scene.joints.length * row + i]) < 1e-5;
    let row = 0;
    while (row < current.count && !start.every((value, i) => near(value, i, row))) row++;
    if (row < current.count) {
      slider.value = row;
      sayRow(row);
    }
    return { go, stop, shown };
  }

  function jointRow(name, i, stop, shown) {
    const value = element("output");
    const slider = element("input", { type: "range", min: lower[i], max: upper[i], step: "any" });
    slider.setAttribute("aria-label", name);
    slider.addEventListener("input", () => {
      stop();
      setPose(pose.map((old, j) => (i === j ? Number(slider.value) : old)));
      shown.textContent = "a custom pose";
    });
    const show = (angle) => {
      slider.value = angle;
      value.textContent = prismatic[i] ? `${(1e3 * angle).toFixed(1)} mm` : `${((180 / Math.PI) * angle).toFixed(1)}\u00b0`;
    };
    sliders.push({ show });
    return element("div", {}, element("div", { className: "line" }, element("span", { textContent: name }), value), slider);
  }

  function buildNotes() {
    if (!scene.notes.length) return;
    const list = element("ul", { id: "notes" });
    for (const note of scene.notes) list.append(element("li", { textContent: note }));
    panel.append(element("details", { open: true }, element("summary", {}, heading("Notes")), list));
  }

  // --- picking -------------------------------------------------------------------------------------------------
  function pickWith(go) {
    const canvas = viewer.renderer.domElement, ray = new THREE.Raycaster();
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
    canvas.addEventListener("pointerup", (event) => {
      if (!down || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4) return;
      const box = canvas.getBoundingClientRect();
      const at = new THREE.Vector2(
        (2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height,
      );
      ray.setFromCamera(at, viewer.camera);
      const shown = [...layers, ...marks].filter((one) => node(one.path).object.visible).map((one) => one.mesh);
      const hit = ray.intersectObjects(shown)[0];
      if (!hit) return;
      const { layer, rows } = hit.object.userData;
      go(layer ? layer.poses : "measured", layer ? hit.instanceId : rows[hit.instanceId]);
    });
  }

  // --- light, camera, floor ------------------------------------------------------------------------------------
  function setStage() {
    viewer.set_property(["Background"], "top_color", [0.165, 0.192, 0.235]);
    viewer.set_property(["Background"], "bottom_color", [0.078, 0.094, 0.122]);
    viewer.set_property(["Axes"], "visible", false);
    const cell = roundDown(scene.reach / 4);
    const floor = new THREE.GridHelper(40 * cell, 40, "#4a5464", "#333b48").rotateX(Math.PI / 2);
    viewer.set_object(["Grid"], floor);
    for (const name of ["PointLightNegativeX", "PointLightPositiveX"]) node(["Lights", name, "<object>"]).object.visible = false;
    node(["Lights", "AmbientLight", "<object>"]).object.intensity = 0.42;
    const sun = new THREE.DirectionalLight("#ffffff", 0.5);
    sun.position.set(1, -1.2, 2);
    viewer.set_object(["Lights", "Sun"], sun);
    const far = scene.reach;
    viewer.camera.fov = 42;
    viewer.camera.near = far / 300;
    viewer.camera.far = far * 200;
    // Points may be close together, as in sockets: the robot is in the picture, too.
    const points = floats(scene.fields.layers[0].points), shown = [];
    for (let k = 0; k < points.length; k += 3) shown.push(new THREE.Vector3().fromArray(points, k));
    const arm = [base, ...linkFrames(pose)].map((frame) => new THREE.Vector3().setFromMatrixPosition(frame));
    const middle = new THREE.Box3().setFromPoints([...shown, ...arm]).getCenter(new THREE.Vector3());
    // The viewer's own axes: y is up.
    const ownAxes = (at) => new THREE.Vector3(at.x, at.z, -at.y), seen = ownAxes(middle);
    const tall = Math.tan((21 * Math.PI) / 180), wide = (tall * view.clientWidth) / view.clientHeight;
    // Links are thicker than their joints' frames are apart, and labels stand beside them.
    const thick = 0.08 * scene.reach;
    const back = new THREE.Vector3(0.72, 0.34, 0.6).normalize(), upwards = new THREE.Vector3(0, 1, 0);
    function away(at, turn) {
      // How far back a point is in the picture, from that far around the vertical.
      const from = back.clone().applyAxisAngle(upwards, turn);
      const right = upwards.clone().cross(from).normalize(), up = from.clone().cross(right);
      const off = ownAxes(at).sub(seen);
      return off.dot(from) + Math.max((Math.abs(off.dot(up)) + thick) / tall, (Math.abs(off.dot(right)) + thick) / wide);
    }
    // Whoever walks around the robot has all of it in the picture.
    const turns = Array.from({ length: 24 }, (_, k) => (k * Math.PI) / 12);
    const distance = Math.max(
      ...shown.map((at) => away(at, 0)), ...arm.flatMap((at) => turns.map((turn) => away(at, turn))),
    );
    viewer.controls.target.copy(seen);
    viewer.camera.position.copy(back.multiplyScalar(distance).add(seen));
    viewer.controls.update();
  }

  // --- all together --------------------------------------------------------------------------------------------
  setStage();
  buildRobot();
  buildFrames();
  buildAxes();
  buildLayers();
  buildPoints();
  beginLabels();
  panel.append(element("h1", { textContent: scene.title }));
  panel.append(element("p", { className: "quiet", textContent: "Deviations of the robot's target, from nominal to actual" }));
  buildLegend();
  buildLayerRows();
  const control = buildPoseRows();
  buildNotes();
  setPose(start);
  redraw();
  pickWith((name, row) => { control.stop(); control.go(name, row); });
  setInterval(follow, 300);

  if (scene.live) {
    // What the program that serves this page has to say: another pose, or another scene.
    new EventSource("events").onmessage = (event) => {
      const message = JSON.parse(event.data);
      if (message.reload) location.reload();
      else if (message.q) { control.stop(); setPose(message.q); control.shown.textContent = "a pose set by the program"; }
    };
  }

  window.viewer = viewer;
  window.pincal = { setPose, layers, scene, ready: null };
  // Two frames later the first picture is on the screen.
  requestAnimationFrame(() => requestAnimationFrame(() => { window.pincal.ready = performance.now(); }));
})();
