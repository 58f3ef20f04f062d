// Programs of controllers: which arm a pose means, the joints at which this robot is there, and the numbers that say so, as in
// pincal/programs/arms.py and correct.py. Poses are 12 numbers, joints those of the robot's description.

const np = { eye: () => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], array: (values) => values };
const ORIENTATIONS = { kuka: CONVENTIONS[0], fanuc: CONVENTIONS[1], abb: CONVENTIONS[2], ur: CONVENTIONS[4] };
const TURN = 2 * Math.PI, ON_EDGE = 1e-4, SAME = 1e-5, NOTHING = 1e-8, ROUNDED = 1e-9, CLEARLY = 0.5, POOL = 6000, MOST_STARTS = 64;
const REASONS = { singular: "the arm is singular there: a small correction would need large joint motions",
  joint_limit: "an axis would leave its limits", unreached: "no joint positions were found" };
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0), minus = (a, b) => a.map((x, i) => x - b[i]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const column = (pose, j) => [pose[j], pose[4 + j], pose[8 + j]];
const times = (matrix, v) => matrix.map((row) => dot(row, v));

Object.defineProperty(MODULES.program.Point.prototype, "values", { get() { return this.numbers.map((number) => number.value); } });
Object.assign(MODULES.language.ControllerLanguage.prototype, {
  pose(values) {
    const turn = ORIENTATIONS[this.convention], unit = turn.kind === "angles" ? DEGREE : 1;
    return posed(rotationOf(turn, values.slice(3).map((x) => x * unit)), values.slice(0, 3).map((x) => x * this.length));
  },
  is_pose(values) {
    if (!(largest(values.slice(0, 3)) * this.length < 1e4 && largest(values.slice(3)) < 1e5)) return false;
    return values.length !== 7 || Math.abs(norm(values.slice(3)) - 1) < 2e-3;
  },
  // The numbers of a pose, of all that mean it those nearest to others.
  numbers(pose, near) {
    const turn = ORIENTATIONS[this.convention], place = column(pose, 3).map((x) => x / this.length);
    if (turn.kind !== "angles") return [...place, ...valuesOf(turn, pose, near.slice(3))];
    const old = [..."xyz"].map((axis) => near[3 + turn.order.indexOf(axis)]);
    const flat = Math.hypot(pose[9], pose[10]) < 1e-9, y = Math.sign(-pose[8]);
    const z = flat ? Math.atan2(-pose[1], pose[5]) / DEGREE + y * old[0] : Math.atan2(pose[4], pose[0]) / DEGREE;
    const angles = flat ? [old[0], 90 * y, z] : [Math.atan2(pose[9], pose[10]) / DEGREE, Math.atan2(-pose[8], Math.hypot(pose[9], pose[10])) / DEGREE, z];
    const ways = flat ? [angles] : [angles, [angles[0] + 180, 180 - angles[1], angles[2] + 180]];
    const moved = ways.map((way) => way.map((x, i) => x - 360 * rint((x - old[i]) / 360)));
    const best = moved.reduce((a, b) => (largest(minus(b, old)) < largest(minus(a, old)) ? b : a));
    return [...place, ...[...turn.order].map((axis) => best["xyz".indexOf(axis)])];
  },
  frame(text) {
    const values = text.split(/[,;]/).map((part) => readNumber(part.trim(), false)), turn = ORIENTATIONS[this.convention];
    if (values.length !== 3 + turn.columns.length || !values.every(Number.isFinite) || !this.is_pose(values)) {
      throw new Refused(`"${text}" is not a frame in ${this.name}; expected X,Y,Z [${this.length === 1 ? "m" : "mm"}],${turn.columns.join(",")}`);
    }
    return this.pose(values);
  },
  joint_units(turns) { return turns.map((is) => (is ? (this.in_degrees ? DEGREE : 1) : this.length)); },
});
MODULES.jbi.Jbi.prototype.joint_units = function units(turns) { return turns.map((_, i) => DEGREE / (this.pulses ? this.pulses[i] : 1)); };

// --- the nominal arm, searched for joint positions

const ARM = (() => {
  const has_sides = ABOUT.types_of_all.length === 6 && ABOUT.types_of_all.every((kind) => kind !== "prismatic") && JOINTS.length === 6;
  const inverse = ABOUT.reported, at = (q, conditions = {}) => ({ payload: 0, temperature: 0, time: 0, target: 0, approach: q.map(() => 0), ...conditions, q: times(inverse, q) });
  // Frames whose z axes are those of the joints, and the pose of the tip.
  function frames(q) {
    const axes = [];
    let T = ABOUT.arm.first;
    ABOUT.follows.forEach(([k, factor, offset], i) => {
      const value = factor * q[k] + offset, slides = ABOUT.types_of_all[i] === "prismatic", [c, s] = slides ? [1, 0] : [Math.cos(value), Math.sin(value)];
      axes.push(product(T, ABOUT.arm.before[i]));
      T = product(axes[i], product([c, -s, 0, 0, s, c, 0, 0, 0, 0, 1, slides ? value : 0], ABOUT.arm.after[i]));
    });
    return { axes, tip: product(T, ABOUT.arm.tip) };
  }
  const zero = JOINTS.map(() => 0), target = product(inverted(frames(zero).tip), nominal(at(zero))[0]);
  // Where two lines along z are nearest to each other, on the first.
  function nearest(first, second) {
    const [p, u, r, v] = [column(first, 3), column(first, 2), column(second, 3), column(second, 2)], cosine = dot(u, v), apart = 1 - cosine ** 2;
    const along = apart < 1e-9 ? 0 : (dot(minus(r, p), u) - cosine * dot(minus(r, p), v)) / apart;
    return p.map((x, i) => x + along * u[i]);
  }
  function shape(q, axes, start) {
    const z = column(axes[0], 2), turn = q[0] - start[0], x = [1, 0, 0], looks = x.map((e, i) => e * Math.cos(turn) + cross(z, x)[i] * Math.sin(turn));
    return { looks, wrist: nearest(axes[4], axes[3]), elbow: column(axes[2], 3) };
  }
  const searches = new Map();
  // The arm for programs whose axes are at zero at some joint positions.
  function searched(start) {
    const signs = (() => {
      if (!has_sides) return [1, 1, 1];
      const { axes, tip } = frames(start), { looks, wrist } = shape(start, axes, start), lies = cross([0, 0, 1], looks);
      return [dot(column(axes[1], 2), lies), dot(column(axes[4], 2), lies), dot(column(axes[5], 2), minus(column(tip, 3), wrist))].map((x) => (x < 0 ? -1 : 1));
    })();
    // Front, up and down, as 1 or -1.
    function sides(q) {
      if (!has_sides) return [0, 0, 0];
      const { axes } = frames(q), { looks, wrist, elbow } = shape(q, axes, start), lies = column(axes[1], 2).map((x) => x * signs[0]);
      const sign = Math.sign(dot(minus(wrist, elbow), column(axes[3], 2)));
      const bent = cross(column(axes[3], 2).map((x) => x * sign), column(axes[5], 2).map((x) => x * signs[2]));
      return [dot(minus(wrist, column(axes[0], 3)), looks), dot(cross(minus(column(axes[2], 3), column(axes[1], 3)), minus(wrist, column(axes[1], 3))), lies),
        dot(bent, column(axes[4], 2)) * signs[1]].map(Math.sign);
    }
    let dice = 1, pool = null;
    const draw = () => (dice = (dice * 48271) % 2147483647) / 2147483647;
    const drawn = () => (pool ??= Array.from({ length: POOL }, () => {
      const q = JOINTS.map((_, i) => { const [low, high] = [Math.max(ABOUT.lower[i] ?? -Math.PI, -Math.PI), Math.min(ABOUT.upper[i] ?? Math.PI, Math.PI)]; return low + (high - low) * draw(); });
      return { q, tip: frames(q).tip, sides: sides(q) };
    }));
    // The joint positions that reach a pose of the tip in a posture, whole turns left open.
    function find(tip, posture, near) {
      const wanted = product(tip, target), found = [];
      const allowed = drawn().filter((one) => posture.allows(one.sides));
      const away = (one) => norm(minus(column(one.tip, 3), column(tip, 3))) / ABOUT.reach
        + 0.5 * Math.acos(Math.min(Math.max(0.5 * ([0, 1, 2].reduce((sum, j) => sum + dot(column(one.tip, j), column(tip, j)), 0) - 1), -1), 1));
      const starts = allowed.map((one) => [away(one), one.q]).sort((a, b) => a[0] - b[0]).slice(0, posture.is_whole ? MOST_STARTS / 2 : MOST_STARTS).map(([, q]) => q);
      for (const q of [near, ...starts]) {
        if (found.length && posture.is_whole) break;
        const one = newton(nominal, wanted, at(q)), joints = times(ABOUT.combination, one.q);
        if (!one.reached || !posture.allows(sides(joints))) continue;
        if (!found.some((other) => largest(joints.map((x, i) => { const d = x - other[i]; return ABOUT.types[i] === "prismatic" ? d : d - TURN * rint(d / TURN); })) < SAME)) found.push(joints);
      }
      return found;
    }
    return { sides, find };
  }
  return { at, target, has_sides, inverse, tip: (q) => frames(q).tip,
    of: (start) => { const key = start.join(); if (!searches.has(key)) searches.set(key, searched(start)); return searches.get(key); } };
})();

// How the axes of a program follow from the joints: axes = matrix joints + zeros, by a text such as "q1, 90-q2, q3-q2".
function programAxes(text) {
  const n = JOINTS.length, reported = ABOUT.reported;
  if (!text.trim()) return axesOf(reported, JOINTS.map(() => 0));
  const parts = text.split(","), rows = [], zeros = [];
  for (const part of parts) {
    const row = JOINTS.map(() => 0);
    let zero = 0, rest = part.replace(/\s/g, "");
    for (const m of rest.matchAll(/([+-]?)(?:q(\d+)|(\d+\.?\d*|\.\d+))/g)) {
      if (m[2] !== undefined && row[Number(m[2]) - 1] === undefined) rest = "?";
      else if (m[2] !== undefined) row[Number(m[2]) - 1] += m[1] === "-" ? -1 : 1;
      else zero += Number(m[1] + m[3]) * DEGREE;
    }
    if (!/^([+-]?(q\d+|\d+\.?\d*|\.\d+))+$/.test(rest)) throw new Refused(`axes "${text}"; expected ${n} sums such as q1, 90-q2, q3-q2, of joints 1 to ${n}`);
    rows.push(row);
    zeros.push(zero);
  }
  const inverse = rows.length === n ? invertedMatrix(rows) : null;
  if (!inverse) throw new Refused(`axes "${text}"; expected ${n} sums such as q1, 90-q2, q3-q2, of joints 1 to ${n}`);
  return axesOf(rows.map((row) => JOINTS.map((_, j) => row.reduce((sum, x, k) => sum + x * reported[k][j], 0))), zeros);
}
function axesOf(matrix, zeros) {
  const inverse = invertedMatrix(matrix);
  return { to_program: (q) => times(matrix, q).map((x, i) => x + zeros[i]), to_robot: (axes) => times(inverse, minus(axes, zeros)) };
}
function invertedMatrix(A) {
  const n = A.length, rows = A.map((row, i) => [...row, ...row.map((_, j) => Number(i === j))]);
  for (let i = 0; i < n; ++i) {
    const best = rows.slice(i).reduce((k, row, d) => (Math.abs(row[i]) > Math.abs(rows[k][i]) ? i + d : k), i);
    [rows[i], rows[best]] = [rows[best], rows[i]];
    if (Math.abs(rows[i][i]) < 1e-9) return null;
    rows[i] = rows[i].map((x) => x / rows[i][i]);
    rows.forEach((row, k) => { if (k !== i) rows[k] = row.map((x, j) => x - row[i] * rows[i][j]); });
  }
  return rows.map((row) => row.slice(n));
}

// --- a program whose points are corrected

class ProgramCorrector {
  // The cell has tools and bases by name, world and flange, axes, a seed, conditions, and how far a joint may move.
  constructor(language, cell) {
    Object.assign(this, { language, cell, units: language.joint_units(ABOUT.types.map((kind) => kind !== "prismatic")) });
    this.arm = ARM.of(cell.axes.to_robot(JOINTS.map(() => 0)));
  }
  joints(values) { return this.cell.axes.to_robot(values.map((x, i) => x * this.units[i])); }
  frame(frame, option, declared) {
    if (frame.pose) return frame.pose;
    const given = this.cell[`${option}s`][frame.name], pose = declared.get(frame.name);
    if (frame.reason) {
      const is_open = frame.reason.includes(MODULES.flow.OUTSIDE);
      if (is_open && given) return given;
      if (is_open) this.asked.push({ option, name: frame.name });
      return frame.reason;
    }
    if (typeof pose === "string") return `${option} ${frame.name}: ${pose}`;
    if (pose && given && largest(minus(pose, given)) > ROUNDED) return `${option} ${frame.name}: the program states other values than those entered below`;
    if (pose ?? given) return pose ?? given;
    this.asked.push({ option, name: frame.name });
    return `the values of ${option} ${frame.name || "of this motion"} are not known: enter them below`;
  }
  frames(point, program) {
    const { Frame } = MODULES.program, none = new Frame("");
    const base = this.frame(point.base ?? none, "base", program.bases), tool = this.frame(point.tool ?? none, "tool", program.tools);
    return typeof base === "string" ? base : typeof tool === "string" ? tool : [product(this.cell.world, base), inverted(product(this.cell.flange, tool))];
  }
  refusal(point) {
    const reason = this.language.refusal(point), n = JOINTS.length;
    if (reason) return reason;
    if (point.kind !== "joints") return n === 6 ? "" : `a pose does not determine the joints of an arm with ${n} joints`;
    if (!(largest(this.joints(point.values)) <= 1e5)) return "its numbers are no joint positions";
    if (point.numbers.length !== n) return `${MODULES.program.counted_axes(point.numbers.length)}; the model has ${n}`;
    const beyond = this.joints(point.values).findIndex((x, i) => x < (ABOUT.lower[i] ?? -Infinity) - 1e-6 || x > (ABOUT.upper[i] ?? Infinity) + 1e-6);
    return beyond < 0 ? "" : `${JOINTS[beyond]} is beyond its limits in the model`;
  }
  // Corrections of a program's points, and what is left as it was.
  changes(program) {
    const left = program.skipped.slice(), joints = new py.Dict(), changed = [], uses = this.uses(program);
    const leave = (point, reason) => left.push(point.skip(reason));
    this.asked = [];
    for (const [key, point] of program.points.items()) {
      const frames = point.kind === "pose" ? this.frames(point, program) : [this.cell.world, inverted(this.cell.flange)];
      const reason = typeof frames === "string" ? frames : this.refusal(point);
      if (reason) { leave(point, reason); continue; }
      const q = point.kind === "joints" ? this.joints(point.values) : this.chosen(point, product(product(frames[0], this.language.pose(point.values)), frames[1]), uses.get(key), joints);
      if (typeof q === "string") { leave(point, q); continue; }
      joints.set(key, q);
      const payload = this.payload(program, key, q);
      if (typeof payload === "string") { leave(point, payload); joints.set(key, q); continue; }
      const change = this.corrected(point, q, frames, payload);
      if (change.reason) leave(point, change.reason);
      changed.push({ point, q, frames, ...change });
    }
    const shared = new Map(), numbersOf = (point) => [...new Set(point.posture.turns.map((turn) => turn.number.start))].map((start) => `${point.source} ${start}`);
    for (const point of program.points.values()) for (const number of numbersOf(point)) shared.set(number, (shared.get(number) ?? 0) + 1);
    for (const change of changed) {
      if (change.reason) continue;
      if (this.turnEdits(change).some((edit) => shared.get(`${edit.source} ${edit.start}`) > 1)) {
        change.reason = "it shares a turn number, which would change";
        leave(change.point, change.reason);
      }
    }
    return { changed, left };
  }
  // How a program first comes to each of its points.
  uses(program) {
    const uses = new py.Dict(program.points.keys().map((key) => [key, { start: null, is_line: false, takes_posture: true }])), seen = new Set();
    let before = "", at = null;
    for (const [motion, stops] of program.motions) {
      const run = `${motion.source} ${motion.run}`;
      if (run !== before) at = null;
      for (const key of stops) {
        if (key !== null && uses.has(key) && !seen.has(String(key))) {
          uses.set(key, { start: at, is_line: motion.path !== "joint", takes_posture: motion.takes_posture });
          seen.add(String(key));
        }
        at = key;
      }
      if (!stops.length) at = null;
      before = run;
    }
    return uses;
  }
  chosen(point, tip, use, joints) {
    const { Posture } = MODULES.program, start = use.start === null ? null : joints.get(use.start);
    let posture = point.posture, known = start;
    if (point.near !== null && point.near.length === JOINTS.length) known = this.joints(point.near);
    else if (start && use.is_line && ARM.has_sides && !(use.takes_posture && posture.is_whole)) {
      posture = new Posture(...this.arm.sides(start).map((side) => (side ? side > 0 : null)));
    }
    const all = joints.values(), guess = known ?? (all.length ? all[all.length - 1] : this.cell.seed), is_told = Boolean(known) || (ARM.has_sides && posture.is_whole);
    if (!guess && !is_told) return "nothing before it determines the arm configuration: set the joints that the first point starts from";
    const near = guess ?? JOINTS.map(() => 0), found = this.arm.find(tip, posture, near);
    const reached = found.filter((q) => posture.allows(this.arm.sides(q))).map((q) => this.turned(q, posture, near)).filter((q) => q);
    if (!reached.length) return "no joint positions within the limits reach it in its posture, by the nominal model";
    reached.sort((a, b) => norm(minus(a, near)) - norm(minus(b, near)));
    if (!is_told && reached.length > 1 && largest(minus(reached[0], near)) > CLEARLY * largest(minus(reached[1], near))) {
      return "several arm configurations reach it, and the motion before it does not determine one: set the joints that the first point starts from";
    }
    return reached[0];
  }
  // Joint positions moved by whole turns into the limits, as the turn numbers say and else near others.
  turned(q, posture, near) {
    const out = q.slice();
    for (let i = 0; i < q.length; ++i) {
      const wanted = posture.turns.filter((turn) => turn.joint === i), turns = ABOUT.types[i] === "prismatic" ? [0] : [-4, -3, -2, -1, 0, 1, 2, 3, 4];
      const inside = turns.map((k) => q[i] + TURN * k).filter((x) => x >= (ABOUT.lower[i] ?? -Infinity) - 1e-9 && x <= (ABOUT.upper[i] ?? Infinity) + 1e-9
        && wanted.every((turn) => this.counts(q.map((y, k) => (k === i ? x : y)), turn)));
      if (!inside.length) return null;
      out[i] = inside.reduce((best, x) => (Math.abs(x - near[i]) < Math.abs(best - near[i]) ? x : best));
    }
    return out;
  }
  // Whether a turn number holds at joint positions or hardly beside them.
  counts(q, turn) {
    return [-ON_EDGE, 0, ON_EDGE].some((aside) => turn.counted(this.cell.axes.to_program(q.map((x, k) => (k === turn.joint ? x + aside : x)))[turn.joint]) === turn.value);
  }
  // The mass at the tip: a load that the program states in numbers, or the one that was entered; or why it is not known.
  payload(program, key, q) {
    const free = this.cell.conditions.payload, loads = program.loads.get(key, []);
    const [light, heavy] = [0, 1].map((payload) => calibrated(ARM.at(q, { ...this.cell.conditions, payload }))[0]);
    if (!loads.some((load) => load) || largest(minus(light, heavy)) === 0) return free;
    const texts = new Set(program.loads.values().flat().filter((load) => load).map((load) => load.text));
    const unknown = loads.find((load) => load && load.mass === null);
    if (unknown && texts.size > 1) return `line ${unknown.line}: its load is not in numbers, and the program has several`;
    const wrong = loads.find((load) => load && load.mass !== null && !(load.mass >= 0 && load.mass <= 1e4));
    if (wrong) return `line ${wrong.line}: a load of ${wrong.mass} kg; expected 0 to 10000 kg`;
    const masses = new Set(loads.map((load) => load?.mass ?? free));
    return masses.size === 1 ? [...masses][0] : "motions reach it with different loads";
  }
  corrected(point, q, frames, payload) {
    const state = ARM.at(q, { ...this.cell.conditions, payload }), tip = ARM.tip(q), wanted = product(tip, ARM.target), solved = compensate(calibrated, wanted, state);
    const commanded = times(ABOUT.combination, solved.q), moved = commanded.map((x, i) => Math.abs(x - q[i])), most = moved.indexOf(largest(moved));
    const after = { ...state, q: solved.q }, before = distances(calibrated(state)[0], wanted), sides = this.arm.sides(q);
    let reason = solved.status === "ok" ? "" : REASONS[solved.status] ?? solved.status;
    if (!reason && moved[most] > this.cell.most) reason = `${JOINTS[most]} would move by ${Number((moved[most] / DEGREE).toPrecision(3))} deg`;
    else if (!reason && this.arm.sides(commanded).some((side, i) => side * sides[i] < 0)) reason = "the correction would change the arm's posture";
    const [was, is] = [tip, ARM.tip(commanded)].map((T) => product(product(inverted(frames[0]), T), inverted(frames[1])));
    const values = point.kind === "pose" ? this.language.numbers(is, point.values) : this.cell.axes.to_program(commanded).map((x, i) => x / this.units[i]);
    const has_posture = point.posture.allows(sides) && point.posture.turns.every((turn) => this.counts(q, turn));
    return { reason, commanded, values, has_posture, wanted, state, after, before, arrived: distances(calibrated(after)[0], wanted),
      shift: norm(minus(column(is, 3), column(was, 3))), turn: norm(difference(was, is).slice(3)) };
  }
  turnEdits({ point, q, commanded, has_posture }) {
    const axes = [commanded, q].map(this.cell.axes.to_program), edits = [], seen = new Set();
    for (const { number } of has_posture ? point.posture.turns : []) {
      if (seen.has(number.start)) continue;
      seen.add(number.start);
      const text = this.language.turn_text(point.posture.turns.filter((turn) => turn.number.start === number.start), ...axes);
      if (text !== number.text) edits.push({ source: point.source, start: number.start, end: number.end, text });
    }
    return edits;
  }
  edits(change) {
    const { point } = change;
    if (change.reason || Math.max(change.shift, change.turn, largest(minus(change.commanded, change.q))) < NOTHING) return [];
    const texts = this.language.point_numbers(point, change.values);
    const edits = point.numbers.map(({ start, end }, i) => ({ source: point.source, start, end, text: texts[i] }));
    return [...edits.filter((edit, i) => edit.text !== point.numbers[i].text), ...this.turnEdits(change)];
  }
}

// Correct programs: files [{name, text}] of one language, and what was entered: tools, bases, world, flange, axes, pulses, start.
function correctPrograms(kind, files, options, said) {
  let language = new kind();
  if (said.pulses?.trim()) language = language.with_pulses(said.pulses);
  const placed = (text, usual) => (text?.trim() ? language.frame(text) : usual);
  const named = (option) => Object.fromEntries(Object.entries(said[option] ?? {}).filter(([, text]) => text.trim()).map(([name, text]) => [name, language.frame(text)]));
  const { payload, temperature, time, target } = options, cell = { tools: named("tool"), bases: named("base"), world: placed(said.world, ABOUT.world), flange: placed(said.flange, ABOUT.flange),
    axes: programAxes(said.axes ?? ""), seed: said.seed ? times(ABOUT.combination, said.seed) : null, conditions: { payload, temperature, time, target }, most: 2 * DEGREE };
  const corrector = new ProgramCorrector(language, cell), asked = [], rows = [], left = [], out = [];
  for (const { own, others } of groupsOf(kind, files)) {
    const group = [...own, ...others], program = language.read(group.map((file) => new Source(file.name, file.text)));
    program.leave(others.map((_, i) => own.length + i));
    const { changed, left: lost } = corrector.changes(program), edits = changed.flatMap((change) => corrector.edits(change));
    asked.push(...corrector.asked);
    left.push(...lost.map((one) => ({ ...one, file: group[one.source].name })));
    for (const change of changed) {
      const { point } = change;
      rows.push({ line: point.line, name: point.name, file: group[point.source].name, status: change.reason || "ok", seed: change.state.q, q: change.after.q, wanted: change.wanted,
        state: change.after, from: calibrated(change.state)[0], before: change.before, after: change.arrived, shift: change.shift, turn: change.turn });
    }
    own.forEach((file, i) => {
      let text = file.text;
      for (const edit of edits.filter((one) => one.source === i).sort((a, b) => b.start - a.start)) text = text.slice(0, edit.start) + edit.text + text.slice(edit.end);
      out.push({ name: file.name, text });
    });
  }
  const pulses = left.some((one) => one.reason.includes("--pulses"));
  return { files: out, rows, left, asked: [...new Map(asked.map((one) => [`${one.option} ${one.name}`, one])).values()], pulses, kind };
}
const stem = (name) => name.toLowerCase().replace(/\.[^.]*$/, "");
const suffix = (name) => `.${name.toLowerCase().split(".").pop()}`;
// The language of a file by its suffix, null if it is no program.
function languageOf(name) { return LANGUAGES.known.find((kind) => kind.prototype.suffixes.includes(suffix(name))) ?? null; }
// Programs, each of its own files and of others that are only read: of KUKA's the data without a source, of ABB's other modules.
function groupsOf(kind, files) {
  const { is_pair, reads_others, suffixes } = kind.prototype, order = (file) => suffixes.indexOf(suffix(file.name));
  const sources = new Set(files.filter((file) => order(file) === 0).map((file) => stem(file.name)));
  const isRead = (file) => is_pair && sources.size && !sources.has(stem(file.name)), groups = new Map();
  for (const file of files.filter((one) => !isRead(one))) {
    const key = is_pair ? stem(file.name) : file.name;
    groups.set(key, [...(groups.get(key) ?? []), file].sort((a, b) => order(a) - order(b)));
  }
  return [...groups.values()].map((own) => ({ own, others: reads_others ? files.filter((file) => (is_pair ? isRead(file) : !own.includes(file))) : [] }));
}
