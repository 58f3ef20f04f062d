// The page: files in and out, the table of corrections, and the drawing.

const $ = (id) => document.getElementById(id);
const SHOWN_ROWS = 500;
const WORDS = { ok: "corrected", joint_limit: "beyond a joint limit", singular: "singular", unreached: "out of reach", no_pose: "no pose" };
const options = { payload: 0, temperature: ABOUT.days.temperature ?? 0, time: ABOUT.days.time ?? 0, target: 0, frame: ABOUT.frame,
  start: ABOUT.start.slice() };
// What programs do not say of their cell, as it was entered.
const said = { tool: {}, base: {}, world: "", flange: "", axes: "", pulses: "", seed: null };
let chosen = [], result = null, here = 0;

// --- settings

function field(label, input, wide) {
  const box = document.createElement("label");
  box.append(label, input);
  box.className = wide ? "wide" : "";
  $("fields").append(box);
}
function choice(label, values, key) {
  const input = document.createElement("select");
  for (const [value, words] of values) input.add(new Option(words, value));
  input.value = options[key];
  input.onchange = () => { options[key] = key === "target" ? Number(input.value) : input.value; run(); };
  field(label, input, true);
}
function quantity(label, get, set) {
  const input = document.createElement("input");
  input.inputMode = "decimal";
  input.value = String(Number(get().toFixed(4)));
  input.onchange = () => {
    const value = readNumber(input.value.trim(), true);
    input.setAttribute("aria-invalid", String(!Number.isFinite(value)));
    if (Number.isFinite(value)) { set(value); run(); } else input.value = String(Number(get().toFixed(4)));
  };
  field(label, input);
}
function settings() {
  if (ABOUT.base) choice("Positions x y z are in", [["base", "the robot's base frame"], ["instrument", "the instrument's frame"]], "frame");
  if (TARGETS.length > 1) choice("Target", TARGETS.map((name, i) => [i, name]), "target");
  for (const [name, words] of [["payload", "Payload [kg]"], ["temperature", "Temperature [°C]"], ["time", "Time [s]"]]) {
    if (ABOUT.needs.includes(name)) quantity(words, () => options[name], (v) => { options[name] = v; });
  }
  JOINTS.forEach((name, i) => {
    const size = ABOUT.types[i] === "prismatic" ? 1e-3 : DEGREE;
    quantity(`Start of ${name} [${size === DEGREE ? "°" : "mm"}]`, () => options.start[i] / size, (v) => { options.start[i] = v * size; said.seed = options.start; });
  });
  for (const [name, words, hint] of [["world", "Controller's world in the robot's base", "as in the robot's description"],
    ["flange", "Controller's flange on the robot's tip", "as in the robot's description"], ["axes", "Axes by the model's joints", "q1, 90-q2, q3-q2, ..."]]) {
    entry("fields", words, hint, () => said[name], (text) => { said[name] = text; });
  }
}
// A field for numbers or sums, as programs have them.
function entry(place, words, hint, get, set) {
  const box = document.createElement("label"), input = Object.assign(document.createElement("input"), { value: get(), placeholder: hint });
  input.onchange = () => { set(input.value); run(); };
  box.append(words, input);
  box.className = "wide";
  $(place).append(box);
}
// Fields for what the program does not say.
function ask() {
  $("asked").replaceChildren();
  $("ask").hidden = !(result?.asked?.length || Object.keys({ ...said.tool, ...said.base }).length || result?.pulses || said.pulses);
  if (!result?.kind) { $("ask").hidden = true; return; }
  const { convention, length } = result.kind.prototype, columns = ORIENTATIONS[convention].columns.join(", ");
  const open = [...Object.keys(said.tool).map((name) => ({ option: "tool", name })), ...Object.keys(said.base).map((name) => ({ option: "base", name })), ...result.asked].sort((a, b) => b.option.localeCompare(a.option));
  for (const { option, name } of new Map(open.map((one) => [`${one.option} ${one.name}`, one])).values()) {
    entry("asked", `${option === "tool" ? "Tool" : "Base"} ${name}`, `X, Y, Z [${length === 1 ? "m" : "mm"}], ${columns}`, () => said[option][name] ?? "", (text) => { said[option][name] = text; });
  }
  if (result.pulses || said.pulses) entry("asked", "Pulses per degree of each axis", "P1 P2 ...", () => said.pulses, (text) => { said.pulses = text; });
}

// --- files

async function take(files) {
  if (!files.length) return;
  chosen = [];
  for (const file of files) {
    const bytes = new Uint8Array(await file.arrayBuffer()), parts = [];
    for (let i = 0; i < bytes.length; i += 8192) parts.push(String.fromCharCode(...bytes.subarray(i, i + 8192)));
    chosen.push({ name: file.name, text: parts.join("") });
  }
  run();
}
// What the chosen files are with corrected numbers: programs of one controller, or a table.
function correctAll() {
  const kinds = new Set(chosen.map((file) => languageOf(file.name))), [kind] = kinds;
  if (kinds.size > 1 || (!kind && chosen.length > 1)) throw new Refused("several files that are not programs of one controller: drop one table, or the files of one program");
  if (kind) return correctPrograms(kind, chosen, options, said);
  const { text, rows, notes } = correct(chosen[0].name, chosen[0].text, options);
  return { files: [{ name: chosen[0].name.replace(/(\.[^.]*)?$/, "-corrected$1"), text }], rows, notes };
}
function run() {
  result = null;
  here = 0;
  $("refused").hidden = true;
  if (chosen.length) try {
    result = correctAll();
  } catch (error) {
    $("refused").textContent = error instanceof Refused ? error.message : `${chosen[0].name} can't be read (${error.message})`;
    $("refused").hidden = false;
  }
  $("walk").hidden = !result?.rows.length;
  $("result").hidden = !result;
  if (result) { tell(); ask(); }
  draw();
}
function save({ name, text }) {
  const url = URL.createObjectURL(new Blob([Uint8Array.from(text, (c) => c.charCodeAt(0))]));
  const link = Object.assign(document.createElement("a"), { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}

// --- the table of corrections

// How uncertain the model is at corrected points, root mean square over them: where the tool is, not where the base stands.
function doubted(rows) {
  if (!uncertainty) return "";
  const mean = rows.reduce((sum, row) => sum + norm(uncertainty(row.state)) ** 2, 0) / rows.length;
  return ` ${ABOUT.base ? "In the instrument's frame the" : "The"} model is uncertain by ${(1e3 * Math.sqrt(mean)).toFixed(3)} mm (rms) there.`;
}
function tell() {
  const rows = result.rows, ok = rows.filter((row) => row.status === "ok"), left = rows.filter((row) => row.status !== "ok");
  const most = (list, k) => Math.max(0, ...list.map((row) => row.before[k])), all = rows.length + (result.left?.length ?? 0) - (result.kind ? left.length : 0);
  const mean = ok.length ? ok.reduce((sum, row) => sum + row.before[0], 0) / ok.length : 0;
  $("summary").textContent = `${chosen.map((file) => file.name).join(", ")}: ${ok.length} of ${all} points corrected. ` + (ok.length
    ? `Without correction this robot misses by ${(1e3 * mean).toFixed(3)} mm on average and ${(1e3 * most(ok, 0)).toFixed(3)} mm at most.${doubted(ok)}` : "");
  $("saves").replaceChildren(...result.files.map((one) => Object.assign(document.createElement("button"), { textContent: `Save ${one.name}`, disabled: !ok.length, onclick: () => save(one) })));
  const named = (list) => `${list.length > 1 ? `${list.length} lines` : "line"} ${list.length > 1 ? "(" : ""}` +
    `${list.slice(0, 20).join(", ")}${list.length > 20 ? ", ..." : ""}${list.length > 1 ? ")" : ""}`;
  const notes = result.kind ? result.left.map(({ file, line, name, reason }) => ["bad", `left unchanged: ${file} line ${line}, ${name}: ${reason}`])
    : Object.entries(WORDS).map(([status, words]) => [words, left.filter((row) => row.status === status).map((row) => row.line)])
      .filter(([, list]) => list.length).map(([words, list]) => ["bad", `left unchanged, ${words}: ${named(list)}`]);
  const turned = Math.max(0, ...ok.map((row) => row.after[1]));
  if (JOINTS.length < 6 && ok.length) notes.push(["bad", `an arm of ${JOINTS.length} joints reaches positions: orientations remain off by ${(1e3 * turned).toFixed(3)} mrad at most`]);
  const moved = ok.filter((row) => row.q.some((q, i) => Math.abs(q - row.seed[i]) > 2 * DEGREE)).map((row) => row.line);
  if (moved.length) notes.push(["bad", `a joint moves by more than 2° in ${named(moved)}: check it before the robot moves`]);
  notes.push(...(result.notes ?? []).map((note) => ["", note]));
  if (result.kind && ok.length) notes.push(["", "between corrected points lines and circles are not checked: pincal compensate --path-error does that"]);
  if (rows.length > SHOWN_ROWS) notes.push(["", `the table shows the first ${SHOWN_ROWS} of ${rows.length} points; all are in the file`]);
  $("notes").replaceChildren(...notes.map(([kind, text]) => Object.assign(document.createElement("li"), { className: kind, textContent: text })));
  const head = document.createElement("tr"), program = result.kind ? [["point", ""], ["moved by", "mm"], ["moved by", "mrad"]] : [];
  for (const [name, unit] of [["line", ""], ...program, ["off by", "mm"], ["off by", "mrad"], ["", ""],
    ...JOINTS.map((name, i) => [`Δ ${name}`, ABOUT.types[i] === "prismatic" ? "mm" : "deg"])]) {
    const cell = document.createElement("th");
    cell.append(name, Object.assign(document.createElement("small"), { textContent: unit }));
    head.append(cell);
  }
  $("rows").tHead.replaceChildren(head);
  $("rows").tBodies[0].replaceChildren(...rows.slice(0, SHOWN_ROWS).map((row, i) => {
    const line = document.createElement("tr"), is_ok = row.status === "ok", add = (text, kind = "") => {
      line.append(Object.assign(document.createElement("td"), { textContent: text, className: kind }));
    };
    add(row.line);
    if (result.kind) [row.name, is_ok ? (1e3 * row.shift).toFixed(4) : "", is_ok ? (1e3 * row.turn).toFixed(4) : ""].forEach((text) => add(text));
    add(row.before ? (1e3 * row.before[0]).toFixed(3) : "");
    add(row.before ? (1e3 * row.before[1]).toFixed(3) : "");
    add(is_ok ? "✓" : result.kind ? "left" : WORDS[row.status], is_ok ? "" : "bad");
    row.q.forEach((q, k) => add(is_ok ? ((q - row.seed[k]) / (ABOUT.types[k] === "prismatic" ? 1e-3 : DEGREE)).toFixed(4) : ""));
    line.onclick = () => show(i);
    return line;
  }));
  $("row").max = rows.length - 1;
  if (rows.length) show(0);
}
function show(i) {
  here = i;
  $("row").value = i;
  const row = result.rows[i];
  $("which").textContent = `${i + 1} of ${result.rows.length}, line ${row.line}`;
  [...$("rows").tBodies[0].rows].forEach((line, k) => line.classList.toggle("here", k === i));
  draw();
}

// --- the drawing: the arm as strokes, seen from any side

const eye = { turn: -0.9, tilt: 0.35, zoom: 1 };
const UP = (() => {
  // The rotation that turns "up" upwards by the shortest way.
  const [x, y, z] = norm(ABOUT.up) ? ABOUT.up : [0, 0, 1], s = Math.hypot(x, y), angle = Math.atan2(s, z);
  return s > 1e-9 ? fromQuaternion(quaternionOf([y / s * angle, -x / s * angle, 0])) : [1, 0, 0, 0, z < 0 ? -1 : 1, 0, 0, 0, z < 0 ? -1 : 1];
})();
// The joints of the arm from its base to the target, and the directions of their axes, in the base frame.
function armAt(q, target) {
  const { arm, follows, nodes } = ABOUT, points = [[0, 0, 0]], axes = [];
  let T = arm.first;
  follows.forEach(([k, factor, offset], i) => {
    const value = factor * q[k] + offset, slides = ABOUT.types_of_all[i] === "prismatic", [c, s] = slides ? [1, 0] : [Math.cos(value), Math.sin(value)];
    const joint = product(T, arm.before[i]);
    T = product(joint, product([c, -s, 0, 0, s, c, 0, 0, 0, 0, 1, slides ? value : 0], arm.after[i]));
    points.push([0, 1, 2].map((r) => T[4 * r] * nodes[i][0] + T[4 * r + 1] * nodes[i][1] + T[4 * r + 2] * nodes[i][2] + T[4 * r + 3]));
    axes.push([joint[2], joint[6], joint[10]]);
  });
  const tip = product(T, arm.tip);
  points.push([tip[3], tip[7], tip[11]], target);
  return { points, axes };
}
const upright = (p) => [0, 1, 2].map((i) => UP[3 * i] * p[0] + UP[3 * i + 1] * p[1] + UP[3 * i + 2] * p[2]);
// The sphere about all that is to be seen: the arm from its base to the target, at the points of the program if there is one.
const SEEN = { of: undefined };
function bounds() {
  if (SEEN.of === result && SEEN.start === String(options.start)) return SEEN;
  const rows = result ? result.rows.filter((row) => row.wanted) : [], step = Math.ceil(rows.length / 200) || 1;
  const arms = rows.length ? rows.filter((_, i) => i % step === 0).map((row) => [row.q, row.wanted]) : [[options.start, null]];
  const points = arms.flatMap(([q, pose]) => {
    const at = pose ?? nominal({ ...options, q })[0];
    return armAt(q, [at[3], at[7], at[11]]).points.map(upright);
  });
  const ends = [Math.min, Math.max].map((end) => [0, 1, 2].map((i) => points.reduce((most, p) => end(most, p[i]), points[0][i])));
  const middle = [0, 1, 2].map((i) => (ends[0][i] + ends[1][i]) / 2);
  const radius = points.reduce((most, p) => Math.max(most, Math.hypot(...p.map((v, i) => v - middle[i]))), 0.05 * ABOUT.reach);
  return Object.assign(SEEN, { of: result, start: String(options.start), middle, radius });
}
// Write the names of joints beside these, none over another and none over the edge.
function label(ctx, places, paint, ground) {
  const right = ctx.canvas.getBoundingClientRect().width - 6;
  const taken = [], names = JOINTS.length <= 9 ? JOINTS.map((_, i) => `J${i + 1}`) : JOINTS;
  Object.assign(ctx, { font: "600 12px system-ui, sans-serif", fillStyle: paint, textBaseline: "middle" });
  places.forEach(([beside, y], i) => {
    const text = ABOUT.follows.length === JOINTS.length ? names[i] : JOINTS[ABOUT.follows[i][0]], wide = ctx.measureText(text).width;
    const x = Math.min(beside, right - wide);
    let at = y;
    while (taken.some(([left, top, w]) => Math.abs(top - at) < 14 && x < left + w + 4 && left < x + wide + 4)) at += 14;
    taken.push([x, at, wide]);
    // A rim in the colour of the ground: letters on a dark body can't be read without it.
    Object.assign(ctx, { lineWidth: 4, lineJoin: "round", strokeStyle: ground });
    ctx.strokeText(text, x, at);
    ctx.fillText(text, x, at);
  });
}
function draw() {
  const canvas = $("view"), box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1, ctx = canvas.getContext("2d");
  canvas.width = box.width * ratio;
  canvas.height = box.height * ratio;
  ctx.scale(ratio, ratio);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const reach = ABOUT.reach, { middle: centre, radius } = bounds(), size = 0.46 * Math.min(box.width, box.height) * eye.zoom / radius, [ct, st, cp, sp] =
    [Math.cos(eye.turn), Math.sin(eye.turn), Math.cos(eye.tilt), Math.sin(eye.tilt)];
  const seen = (p, is_upright) => {
    const [x, y, z] = (is_upright ? p : upright(p)).map((v, i) => v - centre[i]), across = -st * x + ct * y, into = ct * x + st * y, middle = z;
    const depth = into * cp + middle * sp, scale = size / (1 - 0.12 * depth / radius);
    return [box.width / 2 + across * scale, box.height / 2 - (middle * cp - into * sp) * scale, depth];
  };
  const stroke = (points, width, paint) => {
    ctx.beginPath();
    points.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
    Object.assign(ctx, { lineWidth: width, strokeStyle: paint, lineCap: "round", lineJoin: "round" });
    ctx.stroke();
  };
  for (let k = -4; k <= 4; ++k) for (const flip of [false, true]) {
    const at = (t) => (flip ? [t, k * reach / 4, 0] : [k * reach / 4, t, 0]);
    stroke([seen(at(-reach), true), seen(at(reach), true)], 1, colour("floor"));
  }
  const rows = result ? result.rows : [], row = rows[here];
  const q = row ? row.q : options.start, state = { ...options, approach: JOINTS.map(() => 0), ...(row?.state ?? {}), q };
  const pose = row ? calibrated(state)[0] : nominal(state)[0], { points, axes } = armAt(q, [pose[3], pose[7], pose[11]]);
  // Of what is seen, too, as the reach of an arm on a track contains its travel.
  const girth = Math.min(0.085 * reach, 0.17 * radius), thick = Math.max(6, girth * size);
  for (let i = 0; i + 1 < points.length; ++i) {
    const taper = i + 2 >= points.length ? 0.25 : Math.max(0.4, 1 - 0.5 * i / axes.length);
    const ends = [seen(points[i]), seen(points[i + 1])];
    stroke(ends, thick * taper, colour(i + 2 >= points.length ? "joint" : "arm"));
    stroke(ends.map(([x, y]) => [x - 0.15 * thick * taper, y - 0.1 * thick * taper]), 0.3 * thick * taper, "rgb(255 255 255 / .22)");
  }
  axes.forEach((axis, i) => {
    const half = 0.53 * girth * Math.max(0.45, 1 - 0.5 * i / axes.length), p = points[i + 1];
    stroke([-1, 1].map((side) => seen(p.map((x, k) => x + side * half * axis[k]))), thick * Math.max(0.5, 1 - 0.45 * i / axes.length), colour("joint"));
  });
  label(ctx, axes.map((_, i) => seen(points[i + 1])).map(([x, y]) => [x + 0.75 * thick + 6, y]), colour("text"), colour("card"));
  const good = rows.filter((r) => r.before), longest = good.reduce((most, r) => Math.max(most, r.before[0]), 0);
  const exact = longest > 0 ? 0.12 * reach / longest : 1, power = 10 ** Math.floor(Math.log10(exact) + 1e-9);
  const factor = longest > 0 ? power * [5, 2, 1].find((d) => d * power <= exact * (1 + 1e-9)) : 1;
  good.slice(0, 5000).forEach((r) => {
    const tail = [3, 7, 11].map((k) => r.wanted[k]), move = [3, 7, 11].map((k) => factor * (r.from[k] - r.wanted[k]));
    const [a, b] = [seen(tail), seen(tail.map((x, k) => x + move[k]))], angle = Math.atan2(b[1] - a[1], b[0] - a[0]);
    const paint = `hsl(${215 - 205 * r.before[0] / longest} 78% 50%)`, barb = Math.min(8, 0.4 * Math.hypot(b[0] - a[0], b[1] - a[1]));
    stroke([a, b], r === row ? 3.5 : 1.6, paint);
    stroke([2.6, -2.6].flatMap((t, i) => [...(i ? [b] : []), [b[0] + barb * Math.cos(angle + t), b[1] + barb * Math.sin(angle + t)]]), r === row ? 3.5 : 1.6, paint);
  });
  if (row) {
    const [x, y] = seen([row.wanted[3], row.wanted[7], row.wanted[11]]);
    ctx.beginPath();
    ctx.arc(x, y, 7, 0, 7);
    Object.assign(ctx, { lineWidth: 2, strokeStyle: colour("text") });
    ctx.stroke();
  }
  const names = JOINTS.every(isNumbered) ? "" : `${JOINTS.map((name, i) => `J${i + 1}: ${name}`).slice(0, 9).join(", ")}. `;
  $("legend").textContent = good.length ? `Arrows: from the intended point to where this robot goes without correction, ${factor.toLocaleString("en")} times as long; the longest is ${(1e3 * longest).toFixed(3)} mm.`
    : `${names}Drag to turn, scroll or pinch to zoom.`;
}

function isNumbered(name, i) {
  return name.replace(/\D/g, "") === `${i + 1}`;
}

function look() {
  const view = $("view"), fingers = new Map(), spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  const zoom = (by) => { eye.zoom = Math.min(Math.max(eye.zoom * by, 0.2), 40); draw(); };
  view.onpointerdown = (e) => { fingers.set(e.pointerId, [e.clientX, e.clientY]); view.setPointerCapture(e.pointerId); };
  view.onpointermove = (e) => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const before = fingers.size === 2 ? spread() : 0;
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (before) { zoom(spread() / before); return; }
    eye.turn -= (e.clientX - old[0]) * 0.008;
    eye.tilt = Math.min(Math.max(eye.tilt + (e.clientY - old[1]) * 0.008, -1.5), 1.5);
    draw();
  };
  view.onpointerup = view.onpointercancel = (e) => fingers.delete(e.pointerId);
  view.onwheel = (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0012)); };
  view.onkeydown = (e) => {
    const keys = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (keys) { eye.turn += keys[0]; eye.tilt += keys[1]; e.preventDefault(); draw(); }
    if (e.key === "+" || e.key === "-") zoom(e.key === "+" ? 1.2 : 1 / 1.2);
  };
}

function begin() {
  settings();
  look();
  $("joints").textContent = JOINTS.join(", ");
  $("file").onchange = async (e) => { await take([...e.target.files]); e.target.value = ""; };
  $("row").oninput = () => show(Number($("row").value));
  const over = (e, is) => { e.preventDefault(); $("drop").classList.toggle("over", is); };
  document.ondragover = (e) => over(e, true);
  document.ondragleave = (e) => over(e, false);
  document.ondrop = (e) => { over(e, false); take([...e.dataTransfer.files]); };
  window.onresize = draw;
  matchMedia("(prefers-color-scheme: dark)").onchange = draw;
  draw();
}
begin();
