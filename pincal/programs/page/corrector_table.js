// Tables: what one means, and the same text again with corrected numbers. Text is a string of bytes.

class Refused extends Error {}

const DEGREE = Math.PI / 180, NUMBERED = new RegExp(`^(?:${ABOUT.numbered})$`, "i");

const CONVENTIONS = [
  { columns: ["A", "B", "C"], order: "zyx", unit: "deg", kind: "angles", words: "KUKA's A B C" },
  { columns: ["W", "P", "R"], order: "xyz", unit: "deg", kind: "angles", words: "FANUC's W P R" },
  { columns: ["q1", "q2", "q3", "q4"], order: "wxyz", unit: "", kind: "quaternion", words: "ABB's quaternion w x y z" },
  { columns: ["Q1", "Q2", "Q3", "Q4"], order: "wxyz", unit: "", kind: "quaternion", words: "ABB's quaternion w x y z" },
  { columns: ["rx", "ry", "rz"], order: "xyz", unit: "rad", kind: "vector", words: "a rotation vector" },
  { columns: ["roll", "pitch", "yaw"], order: "xyz", unit: "rad", kind: "angles", words: "roll, pitch, yaw" },
  { columns: ["Roll", "Pitch", "Yaw"], order: "xyz", unit: "rad", kind: "angles", words: "roll, pitch, yaw" },
  { columns: ["qx", "qy", "qz", "qw"], order: "xyzw", unit: "", kind: "quaternion", words: "a quaternion x y z w" },
];
// Decimals that a written number has at least, as in pincal/compensate/returned_table.py.
const DECIMALS = { m: 11, cm: 9, mm: 8, um: 5, "µm": 5, in: 10, rad: 11, mrad: 8, urad: 5, deg: 9, "°": 9 };
// Sizes beyond which numbers without a unit are taken to be in another one: rad, and reaches of the robot.
const MOST_RAD = 13, MOST_REACHES = 50;
const OTHERS = { tp: "a FANUC binary: save it as .ls", xlsx: "an Excel workbook: save it as CSV", xls: "an Excel workbook: save it as CSV",
  ods: "a spreadsheet: save it as CSV", parquet: "a Parquet table", json: "a JSON file", urp: "a packed PolyScope program: the .script next to it is the program" };

function refuseOther(name, text) {
  const end = name.toLowerCase().split(".").pop();
  if (OTHERS[end]) throw new Refused(`${name} is ${OTHERS[end]}. Or run: pincal compensate model.json ${name} --out corrected.${end}`);
  if (/[\0]/.test(text)) throw new Refused(`${name} is not text in UTF-8 or Latin-1: save it as CSV UTF-8 and drop that.`);
}

function utf8(bytes) {
  try {
    return new TextDecoder("utf-8", { fatal: true }).decode(Uint8Array.from(bytes, (c) => c.charCodeAt(0)));
  } catch { return bytes; }
}

// --- numbers, units, rotations

function quantityUnit(text, quantity) {
  const unit = text.trim().replace("μ", "µ");
  return Object.hasOwn(ABOUT.units[quantity], unit) ? unit : null;
}
function toSI(value, unit) { return unit === "K" ? value - 273.15 : unit ? value * sizeOf(unit) : value; }
function sizeOf(unit) {
  for (const units of Object.values(ABOUT.units)) if (Object.hasOwn(units, unit)) return units[unit];
  return 1;
}
function readNumber(text, comma) {
  const plain = comma ? text.replace(",", ".") : text;
  return /^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$/.test(plain) ? Number(plain) : NaN;
}
// A value [SI] as a number like the one that it replaces: decimal mark, sign, no fewer decimals; that one if it says the same.
function writeNumber(value, unit, old) {
  const has = (/[.,](\d*)/.exec(old) || ["", ""])[1].length, least = DECIMALS[unit] ?? 11, number = value / (unit ? sizeOf(unit) : 1);
  if (Math.abs(number - Number(old.replace(",", "."))) < 0.5 * 10 ** -least) return old;
  const text = number.toFixed(Math.max(has, least)), marked = old.includes(",") ? text.replace(".", ",") : text;
  return old.startsWith("+") && number >= 0 ? `+${marked}` : marked;
}

function product(a, b) {
  const out = new Array(12);
  for (let i = 0; i < 3; ++i) for (let j = 0; j < 4; ++j) {
    out[4 * i + j] = a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j] + (j === 3 ? a[4 * i + 3] : 0);
  }
  return out;
}
function inverted(p) {
  const t = [0, 1, 2].map((i) => -(p[i] * p[3] + p[4 + i] * p[7] + p[8 + i] * p[11]));
  return [p[0], p[4], p[8], t[0], p[1], p[5], p[9], t[1], p[2], p[6], p[10], t[2]];
}
function posed(R, t) { return [0, 1, 2].flatMap((i) => [R[3 * i], R[3 * i + 1], R[3 * i + 2], t[i]]); }

function fromQuaternion([x, y, z, w]) {
  const s = 2 / (x * x + y * y + z * z + w * w);
  return [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
    s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
    s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)];
}
function toVector(p) { return difference([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], p).slice(3); }
function quaternionOf(vector) {
  const angle = norm(vector), s = angle > 0 ? Math.sin(angle / 2) / angle : 0.5;
  return [...vector.map((v) => v * s), Math.cos(angle / 2)];
}
// A rotation, row by row, from numbers in SI units in the order of a convention's columns.
function rotationOf(convention, values) {
  const by = Object.fromEntries([...convention.order].map((axis, i) => [axis, values[i]])), v = [by.x, by.y, by.z];
  if (convention.kind === "quaternion") {
    const q = [...v, by.w];
    if (Math.abs(norm(q) - 1) > 1e-2) throw new Refused(`a quaternion of length ${norm(q).toPrecision(4)}; expected 1`);
    return fromQuaternion(q);
  }
  if (convention.kind === "vector") return fromQuaternion(quaternionOf(v));
  const turns = v.map((angle, i) => fromQuaternion(quaternionOf([0, 1, 2].map((k) => (k === i ? angle : 0)))));
  const [x, y, z] = turns.map((R) => posed(R, [0, 0, 0])), R = product(z, product(y, x));
  return [0, 1, 2, 4, 5, 6, 8, 9, 10].map((i) => R[i]);
}
// Numbers in SI units for a pose's rotation, of all that mean the same the closest to the old ones.
function valuesOf(convention, p, old) {
  const away = (v) => norm(v.map((x, i) => x - old[i])), ordered = (v) => [...convention.order].map((axis) => v["xyzw".indexOf(axis)]);
  const closest = (all) => all.reduce((best, v) => (away(v) < away(best) ? v : best));
  if (convention.kind === "quaternion") {
    const q = ordered(quaternionOf(toVector(p)));
    return closest([q, q.map((x) => -x)]);
  }
  if (convention.kind === "vector") {
    const v = toVector(p), angle = norm(v);
    return angle > 1e-9 ? closest([0, -1, 1].map((k) => v.map((x) => x * (1 + 2 * Math.PI * k / angle)))) : v;
  }
  const flat = Math.hypot(p[0], p[4]), y = Math.atan2(-p[8], flat);
  // With y at a right angle only the sum or difference of the others counts: the last keeps its old value.
  const z = flat > 1e-9 ? Math.atan2(p[4], p[0]) : old[convention.order.indexOf("z")];
  const x = flat > 1e-9 ? Math.atan2(p[9], p[10])
    : Math.atan2(Math.sin(z) * p[2] - Math.cos(z) * p[6], Math.cos(z) * p[5] - Math.sin(z) * p[1]);
  const near = (v) => v.map((a, i) => a + 2 * Math.PI * Math.round((old[i] - a) / (2 * Math.PI)));
  return closest([near(ordered([x, y, z])), near(ordered([x + Math.PI, Math.PI - y, z + Math.PI]))]);
}

// --- tables

// The cells of a line, without quotation marks, each with its place in the line.
function cellsOf(line, separator) {
  if (separator === " ") {
    return [...line.matchAll(/\S+(?:\s+[[(][^\])]*[\])])?/g)].map((m) => ({ text: m[0], start: m.index, end: m.index + m[0].length }));
  }
  const cells = [];
  let start = 0, quoted = false;
  for (let i = 0; i <= line.length; ++i) {
    if (line[i] === '"') quoted = !quoted;
    if (i < line.length && (quoted || line[i] !== separator)) continue;
    const raw = line.slice(start, i), text = raw.trim().replace(/^"(.*)"$/, "$1").trim(), at = start + raw.indexOf(text);
    cells.push({ text, start: at, end: at + text.length });
    start = i + 1;
  }
  return cells;
}

// What quantities the columns of a table may hold, by name.
function known() {
  const found = new Map(JOINTS.map((name, i) => [name, ABOUT.types[i] === "prismatic" ? "length" : "angle"]));
  for (const axis of "xyz") found.set(axis, "length");
  for (const [name, quantity] of [["payload", "mass"], ["temperature", "temperature"], ["time", "time"], ["target", "name"]]) {
    found.set(name, quantity);
  }
  for (const name of JOINTS) found.set(`approach_${name}`, "number");
  return found;
}

// A label as [name, unit] in any spelling: `x [mm]`, `x (mm)`, `x_mm`, `x mm`, `x/mm`.
function spellings(label) {
  const found = [], bracket = /^([^[]*?)\s*\[([^\]]*)\]$/.exec(label) || /^(.*?)\s*\(\s*([^()]*?)\s*\)$/.exec(label);
  if (bracket) return [[bracket[1], bracket[2]]];
  found.push([label, ""]);
  for (const pattern of [/^(.*)_([^_]*)$/, /^(.*?)\s+(\S*)$/, /^(.*?)\s*\/\s*(\S*)$/]) {
    const m = pattern.exec(label);
    if (m && m[2] !== "in" && ["angle", "length", "mass", "time", "temperature"].some((q) => quantityUnit(m[2], q) !== null)) {
      found.push([m[1], m[2]]);
    }
  }
  return found;
}

// The columns that are needed: by name {index, unit, quantity}, and the convention of the orientation.
function understood(labels) {
  const columns = {}, names = known(), taken = new Set(), folded = new Map([...names.keys()].map((n) => [n.toLowerCase(), n]));
  const take = (name, index, unit, quantity, label) => {
    if (name in columns) throw new Refused(`two columns "${name}": delete or rename one of them`);
    if (unit && quantityUnit(unit, quantity) === null) {
      const expected = Object.keys(ABOUT.units[quantity]).map((u) => `[${u}]`).join(", ") || "no unit";
      throw new Refused(`column "${label}": [${unit}] is not a unit of it; expected ${expected}`);
    }
    columns[name] = { index, unit: unit && quantityUnit(unit, quantity), quantity, said: Boolean(unit) };
    taken.add(index);
  };
  for (const exact of [true, false]) labels.forEach((label, index) => {
    const found = taken.has(index) ? null : spellings(label).map(([name, unit]) =>
      [exact ? name : folded.get(name.toLowerCase()), unit]).find(([name]) => names.has(name));
    if (found && (exact || !(found[0] in columns))) take(found[0], index, found[1], names.get(found[0]), label);
  });
  if (!JOINTS.some((name) => name in columns)) {
    const families = {};
    labels.forEach((label, index) => {
      const split = taken.has(index) ? [] : spellings(label).map(([name, unit]) =>
        [NUMBERED.exec(name), unit]).filter(([m]) => m);
      if (split.length) (families[split[0][0][1].toLowerCase()] ??= []).push([Number(split[0][0][2]), index, split[0][1], label]);
    });
    const n = JOINTS.length, whole = Object.entries(families).filter(([prefix, all]) => {
      const order = all.map(([k]) => k).sort((a, b) => a - b);
      return all.length === n && order.every((k, i) => k === order[0] + i) && order[0] <= 1 && !(prefix === "q" && n === 4);
    });
    if (whole.length === 1) whole[0][1].sort((a, b) => a[0] - b[0]).forEach(([, index, unit, label], i) =>
      take(JOINTS[i], index, unit, names.get(JOINTS[i]), label));
  }
  const missing = JOINTS.filter((name) => !(name in columns));
  if (missing.length && missing.length < JOINTS.length) {
    throw new Refused(`no column for joint ${missing.map((n) => `"${n}"`).join(", ")}; the table has ${labels.join(", ")}`);
  }
  const bare = new Map();
  labels.forEach((label, index) => { if (!taken.has(index)) for (const [name, unit] of spellings(label)) bare.set(name, [index, unit, label]); });
  const conventions = CONVENTIONS.filter((c) => c.columns.every((name) => bare.has(name)));
  if (conventions.length > 1) throw new Refused(`orientations as ${conventions.map((c) => c.words).join(" and as ")}: delete one of them`);
  for (const name of conventions[0]?.columns ?? []) {
    const [index, unit, label] = bare.get(name), convention = conventions[0];
    take(`turn ${name}`, index, unit, convention.kind === "quaternion" ? "number" : "angle", label);
    columns[`turn ${name}`].unit ||= convention.unit;
  }
  const convention = conventions[0] ?? null, hasJoints = !missing.length, axes = [..."xyz"].filter((axis) => axis in columns);
  if (axes.length % 3) throw new Refused(`positions need the columns x y z; the table has ${axes.join(" ")}`);
  if (!hasJoints && !axes.length) {
    throw new Refused(`neither joints nor positions; expected columns ${JOINTS.join(" ")}, or x y z with an orientation; the table has ${labels.join(", ")}`);
  }
  const hasPoses = axes.length === 3;
  if (!hasJoints && !convention) throw new Refused("positions without an orientation and without joints: add the columns of either");
  if (!hasJoints && JOINTS.length !== 6) {
    throw new Refused(`poses do not determine the configuration of an arm with ${JOINTS.length} joints: add the columns ${JOINTS.join(" ")}`);
  }
  const left = labels.filter((_, index) => !taken.has(index));
  return { columns, convention: hasPoses ? convention : null, hasJoints, hasPoses, left };
}

// A table: its rows with joints [rad, m], wanted poses and conditions, and the places of the numbers to replace.
function readTable(text, options) {
  const lines = text.split("\n"), skip = (line) => !line.replace(/[ \t,;\r]/g, "") || line.trimStart().startsWith("#");
  const first = lines.findIndex((line) => !skip(line));
  if (first < 0) throw new Refused("the file is empty; expected a header line and one line for each point");
  const header = utf8(lines[first]).replace(/^\uFEFF/, "").replace(/\r$/, "");
  let separator = [",", ";", "\t"].reduce((best, c) => (header.split(c).length > header.split(best).length ? c : best));
  if (!header.includes(separator) && header.trim().split(/\s+/).length > 1) separator = " ";
  const labels = cellsOf(header, separator).map((cell) => cell.text), meaning = understood(labels);
  const { columns, convention, hasJoints, hasPoses } = meaning, rows = [];
  lines.forEach((raw, index) => {
    if (index <= first || skip(raw)) return;
    const cells = cellsOf(raw.replace(/\r$/, ""), separator);
    if (cells.length !== labels.length) {
      throw new Refused(`line ${index + 1}: ${cells.length} cells; expected ${labels.length} as in the header` +
        (separator === "," ? "; decimal commas need ; or a tab between the cells" : ""));
    }
    const number = (name) => {
      const { index: at, unit } = columns[name], value = readNumber(cells[at].text, separator !== ",");
      if (!Number.isFinite(value)) throw new Refused(`line ${index + 1}, column "${labels[at]}": "${utf8(cells[at].text)}" is not a number`);
      return toSI(value, unit);
    };
    const spots = {};
    for (const name of Object.keys(columns)) spots[name] = { ...cells[columns[name].index], line: index, unit: columns[name].unit };
    const row = { line: index + 1, spots, q: hasJoints ? JOINTS.map(number) : null, turn: null, place: null, old: null };
    if (hasPoses) row.place = [..."xyz"].map(number);
    if (hasPoses && convention) {
      row.old = convention.columns.map((name) => number(`turn ${name}`));
      row.turn = rotationOf(convention, row.old);
    }
    row.conditions = conditionsOf(columns, number, (name) => utf8(cells[columns[name].index].text), options, index + 1);
    rows.push(row);
  });
  if (!rows.length) throw new Refused("no row below the header");
  checkUnits(rows, columns, options);
  return { lines, rows, convention, hasJoints, hasPoses, notes: meaning.left.length ? [`columns left unchanged: ${meaning.left.join(", ")}`] : [] };
}

function conditionsOf(columns, number, text, options, line) {
  const out = { payload: options.payload, temperature: options.temperature, time: options.time, target: options.target };
  for (const name of ["payload", "temperature", "time"]) if (name in columns) out[name] = number(name);
  if ("target" in columns) {
    out.target = TARGETS.indexOf(text("target"));
    if (out.target < 0) throw new Refused(`line ${line}: target "${text("target")}" is unknown; expected ${TARGETS.join(", ")}`);
  }
  const sides = JOINTS.filter((name) => `approach_${name}` in columns);
  out.approach = JOINTS.map((name) => (sides.includes(name) ? number(`approach_${name}`) : 0));
  if (ABOUT.needs.includes("approach") && !sides.length) out.lacks = "approach";
  return out;
}

// Refuse numbers that can only be in another unit than the one that no unit stands for.
function checkUnits(rows, columns, options) {
  if (rows[0].q) JOINTS.forEach((name, i) => {
    const far = rows.find((row) => Math.abs(row.q[i]) > MOST_RAD);
    if (far && !columns[name].said && ABOUT.types[i] !== "prismatic") {
      throw new Refused(`line ${far.line}: ${name} is ${far.q[i]} rad, which looks like degrees: write "${name} [deg]" in the header`);
    }
  });
  const away = rows.filter((row) => row.place && norm(toBase(posed([1, 0, 0, 0, 1, 0, 0, 0, 1], row.place), options).filter((_, i) => i % 4 === 3)) > MOST_REACHES * ABOUT.reach);
  if (away.length > rows.length / 2 && !columns.x.said) {
    throw new Refused(`positions lie farther from the robot than ${MOST_REACHES} times its reach: in millimetres? Write "x [mm]" and so on in the header`);
  }
}

// --- correction

function toBase(pose, options) { return options.frame === "instrument" && ABOUT.base ? product(inverted(ABOUT.base), pose) : pose; }
function fromBase(pose, options) { return options.frame === "instrument" && ABOUT.base ? product(ABOUT.base, pose) : pose; }

// Joint positions of the nominal robot for a pose, close to a seed; null if none are found.
function nominalJoints(wanted, state) {
  const direct = compensate(nominal, wanted, state);
  if (direct.status === "ok" && largest(direct.q.map((q, i) => q - state.q[i])) < 1.5) return direct.q;
  let best = direct.status === "ok" ? direct.q : null, dice = 1;
  const away = (q) => norm(q.map((x, i) => x - state.q[i]));
  for (let k = 0; k < 150; ++k) {
    const q = JOINTS.map((_, i) => {
      dice = (dice * 48271) % 2147483647;
      const [low, high] = [Math.max(LOWER[i], -Math.PI), Math.min(UPPER[i], Math.PI)];
      return low + (high - low) * (dice / 2147483647);
    });
    const found = compensate(nominal, wanted, { ...state, q });
    if (found.status === "ok" && (!best || away(found.q) < away(best))) best = found.q;
  }
  return best;
}

// Correct what a table holds: {text, rows}, each row with its error before and after, its change and its status.
function correct(name, text, options) {
  refuseOther(name, text);
  const read = readTable(text, options), notes = read.notes.slice();
  if (read.rows.some((row) => row.conditions.lacks)) {
    notes.push("no columns approach_JOINT: from which side joints arrive is not known, and their backlash is not corrected");
  }
  let last = options.start;
  const edits = [], rows = read.rows.map((row) => {
    const state = { ...row.conditions, q: row.q ?? last };
    let wanted = row.place && row.turn ? toBase(posed(row.turn, row.place), options) : null;
    if (!row.q) {
      const q = nominalJoints(wanted, state);
      if (!q) return { line: row.line, status: "unreached", wanted, q: state.q, seed: state.q };
      state.q = q;
    } else if (row.place && !row.turn) {
      const meant = nominal(state)[0], at = toBase(posed([1, 0, 0, 0, 1, 0, 0, 0, 1], row.place), options);
      wanted = meant.map((x, i) => (i % 4 === 3 ? at[i] : x));
    }
    wanted ??= nominal(state)[0];
    last = state.q;
    const found = compensate(calibrated, wanted, state), after = { ...state, q: found.q };
    if (found.status === "ok") edits.push(...editsOf(row, after, read.convention, options));
    return { line: row.line, status: found.status, wanted, seed: state.q, q: found.q, state: after,
      from: calibrated(state)[0], before: distances(calibrated(state)[0], wanted), after: distances(calibrated(after)[0], wanted) };
  });
  const lines = read.lines.slice();
  for (const { spot, text: number } of edits.sort((a, b) => b.spot.start - a.spot.start)) {
    lines[spot.line] = lines[spot.line].slice(0, spot.start) + number + lines[spot.line].slice(spot.end);
  }
  return { text: lines.join("\n"), rows, notes };
}

// What to write for a corrected row: its joints, or where it has none the pose for a controller with the nominal robot.
function editsOf(row, state, convention, options) {
  const edit = (name, value) => ({ spot: row.spots[name], text: writeNumber(value, row.spots[name].unit, row.spots[name].text) });
  if (row.q) return JOINTS.map((name, i) => edit(name, state.q[i]));
  const pose = fromBase(nominal(state)[0], options), turn = valuesOf(convention, pose, row.old);
  const places = [..."xyz"].map((axis, i) => edit(axis, pose[4 * i + 3]));
  const names = Object.keys(row.spots).filter((name) => name.startsWith("turn "));
  return [...places, ...names.map((name) => edit(name, turn[convention.columns.indexOf(name.slice(5))]))];
}
