// What Python means, for the readers of programs: they are the command's own, translated (tools/python_to_js.py).

const py = (() => {
  class ValueError extends Error {}

  // A dictionary; tuples are keys by their elements.
  class Dict {
    constructor(pairs = []) { this.map = new Map(); for (const [key, value] of pairs) this.set(key, value); }
    static name_of(key) { return Array.isArray(key) ? JSON.stringify(key) : key instanceof Token ? key.text : key; }
    set(key, value) { const name = Dict.name_of(key), old = this.map.get(name); this.map.set(name, [old ? old[0] : key, value]); }
    has(key) { return this.map.has(Dict.name_of(key)); }
    get(key, other = null) { return this.has(key) ? this.map.get(Dict.name_of(key))[1] : other; }
    keys() { return [...this.map.values()].map(([key]) => key); }
    values() { return [...this.map.values()].map(([, value]) => value); }
    items() { return [...this.map.values()].map(([key, value]) => [key, value]); }
    pop(key) { const value = this.get(key); this.map.delete(Dict.name_of(key)); return value; }
    setdefault(key, value = null) { if (!this.has(key)) this.set(key, value); return this.get(key); }
    update(other) { for (const [key, value] of pairs(other)) this.set(key, value); }
  }
  const pairs = (other) => (other instanceof Dict ? other.items() : other);

  const isText = (x) => typeof x === "string" || x instanceof Token;
  const text = (x) => (x instanceof Token ? x.text : x);
  const iter = (x) => (x instanceof Dict ? x.keys() : x instanceof Token ? x.text : x);
  const list = (x = []) => [...iter(x)];
  const truth = (x) => (Array.isArray(x) || typeof x === "string" ? x.length > 0 : x instanceof Token ? x.text.length > 0
    : x instanceof Dict ? x.map.size > 0 : x instanceof Set ? x.size > 0 : Boolean(x));
  function same(a, b) {
    if (isText(a) && isText(b)) return text(a) === text(b);
    if (a === b || (a ?? null) === (b ?? null)) return true;
    if (Array.isArray(a) && Array.isArray(b)) return a.length === b.length && a.every((x, i) => same(x, b[i]));
    if (a instanceof Set && b instanceof Set) return a.size === b.size && [...a].every((x) => b.has(x));
    if (a && b && typeof a === "object" && a.constructor === b.constructor && !(a instanceof Dict)) {
      return Object.keys(a).every((key) => same(a[key], b[key]));
    }
    return typeof a === "boolean" && typeof b === "number" ? Number(a) === b : typeof b === "boolean" && typeof a === "number" && a === Number(b);
  }
  const has = (all, x) => (isText(all) ? text(all).includes(text(x)) : all instanceof Set ? all.has(text(x)) : all instanceof Dict ? all.has(x)
    : list(all).some((y) => same(x, y)));
  const strip = (x, chars, left, right) => {
    const isOut = (c) => (chars === null ? /\s/.test(c) : chars.includes(c));
    let a = 0, b = x.length;
    while (left && a < b && isOut(x[a])) ++a;
    while (right && b > a && isOut(x[b - 1])) --b;
    return x.slice(a, b);
  };
  const some = (x, test) => (Array.isArray(x) ? x.some(test) : test(x));
  const TEXT = {
    upper: (x) => x.toUpperCase(), lower: (x) => x.toLowerCase(),
    split: (x, by = null) => (by === null ? x.split(/\s+/).filter((part) => part) : x.split(by)),
    partition: (x, by) => { const k = x.indexOf(by); return k < 0 ? [x, "", ""] : [x.slice(0, k), by, x.slice(k + by.length)]; },
    strip: (x, c = null) => strip(x, c, true, true), lstrip: (x, c = null) => strip(x, c, true, false), rstrip: (x, c = null) => strip(x, c, false, true),
    startswith: (x, y) => some(y, (part) => x.startsWith(part)), endswith: (x, y) => some(y, (part) => x.endsWith(part)),
    removesuffix: (x, y) => (y && x.endsWith(y) ? x.slice(0, -y.length) : x), removeprefix: (x, y) => (x.startsWith(y) ? x.slice(y.length) : x),
    replace: (x, a, b, most = Infinity) => { const parts = x.split(a); return most >= parts.length - 1 ? parts.join(b) : [parts.slice(0, most + 1).join(b), ...parts.slice(most + 1)].join(a); },
    join: (x, parts) => list(parts).map(text).join(x), isdigit: (x) => /^[0-9]+$/.test(x), isalpha: (x) => /^[A-Za-z\xaa\xb5\xba\xc0-\xd6\xd8-\xf6\xf8-\xff]+$/.test(x),
    rjust: (x, n, fill = " ") => x.padStart(n, fill), find: (x, y) => x.indexOf(y), rfind: (x, y) => x.lastIndexOf(y), index: (x, y) => x.indexOf(y),
    count: (x, y) => x.split(y).length - 1,
  };
  const LIST = {
    append: (x, y) => { x.push(y); return null; }, pop: (x) => x.pop(), index: (x, y) => x.findIndex((z) => same(y, z)),
    count: (x, y) => x.filter((z) => same(y, z)).length,
  };
  const SET = {
    add: (x, y) => { x.add(text(y)); return null; }, union: (x, ...others) => new Set([x, ...others].flatMap((other) => list(other))),
    update: (x, ...others) => { for (const other of others) for (const y of iter(other)) x.add(y); return null; },
  };
  function call(owner, name, ...args) {
    const kind = isText(owner) ? TEXT : Array.isArray(owner) ? LIST : owner instanceof Set ? SET : null;
    if (!kind || !kind[name]) return owner[name](...args);
    return kind[name](text(owner), ...(kind === TEXT ? args.map(text) : args));
  }
  const KINDS = { str: isText, int: (x) => Number.isInteger(x), float: (x) => typeof x === "number" };
  const keyed = (key) => (key ? key : (x) => x);
  const compare = (a, b) => { a = text(a); b = text(b); return Array.isArray(a) ? a.reduce((found, x, i) => found || compare(x, b[i]), 0) : a < b ? -1 : a > b ? 1 : 0; };

  const extreme = (all, sign) => {
    const { key } = all.length > 1 && all[all.length - 1].key ? all.pop() : {};
    return list(all.length > 1 ? all : all[0]).reduce((best, y) => (sign * compare(keyed(key)(y), keyed(key)(best)) > 0 ? y : best));
  };

  return {
    Dict, ValueError, iter, list, truth, same, has, text, call, tuple: list,
    at: (x, i) => (x instanceof Dict ? x.get(i) : text(x)[i < 0 ? text(x).length + i : i]),
    put: (x, i, value) => (x instanceof Dict ? x.set(i, value) : (x[i < 0 ? x.length + i : i] = value)),
    either: (a, b) => (truth(a) ? a : b()), both: (a, b) => (truth(a) ? b() : a),
    add: (a, b) => (Array.isArray(a) ? [...a, ...b] : isText(a) ? text(a) + text(b) : Number(a) + Number(b)),
    sub: (a, b) => (a instanceof Set ? new Set([...a].filter((x) => !b.has(x))) : a - b),
    or: (a, b) => (a instanceof Set ? new Set([...a, ...iter(b)]) : a instanceof Dict ? new Dict([...a.items(), ...b.items()]) : a | b),
    and: (a, b) => (a instanceof Set ? new Set([...a].filter((x) => has(b, x))) : a & b),
    matmul: (a, b) => product(a, b),
    isinstance: (x, kinds) => kinds.some((kind) => (typeof kind === "string" ? KINDS[kind](x) : x instanceof kind)),
    str: (x) => (x === null || x === undefined ? "None" : x === true ? "True" : x === false ? "False" : String(text(x))),
    repr: (x) => (isText(x) ? `'${text(x)}'` : String(x)),
    format: (x, how) => { const m = /^(?:\.(\d+)f|(b)|(X))$/.exec(how); return m[1] ? x.toFixed(Number(m[1])) : m[2] ? x.toString(2) : x.toString(16).toUpperCase(); },
    int: (x, base = 10) => (isText(x) ? parseInt(text(x), base) : Math.trunc(Number(x))),
    float: (x) => { if (isText(x) && !/^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*$/.test(text(x))) throw new ValueError(text(x)); return Number(text(x)); },
    bool: truth, len: (x) => (x instanceof Dict ? x.map.size : x instanceof Set ? x.size : text(x).length),
    set: (x = []) => new Set(list(x).map(text)), frozenset: (x = []) => new Set(list(x).map(text)), dict: (x = []) => new Dict(pairs(x)),
    fromkeys: (x, value = null) => new Dict(list(x).map((key) => [key, value])),
    sorted: (x, { key } = {}) => list(x).sort((a, b) => compare(keyed(key)(a), keyed(key)(b))),
    min: (...all) => extreme(all, -1), max: (...all) => extreme(all, 1),
    sum: (x) => list(x).reduce((a, b) => a + b, 0), any: (x) => list(x).some(truth), all: (x) => list(x).every(truth),
    next: (x, other) => { const [first = other] = list(x); return first; },
    enumerate: (x, start = 0) => list(x).map((y, i) => [i + start, y]), reversed: (x) => list(x).reverse(),
    zip: (...all) => { const lists = all.map(list); return lists[0].slice(0, Math.min(...lists.map((x) => x.length))).map((_, i) => lists.map((x) => x[i])); },
    cached: (kind, name) => {
      const { get } = Object.getOwnPropertyDescriptor(kind, name);
      Object.defineProperty(kind, name, { get() { const value = get.call(this); Object.defineProperty(this, name, { value }); return value; } });
    },
    range: (a, b) => Array.from({ length: Math.max(0, b === undefined ? a : b - a) }, (_, i) => i + (b === undefined ? 0 : a)),
    map: (f, x) => list(x).map((y) => f(y)), filter: (f, x) => list(x).filter((y) => truth(f ? f(y) : y)), abs: Math.abs,
    round: (x, n = 0) => (n ? Number(x.toFixed(n)) : rint(x)),
    hasattr: (x, name) => name in x, getattr: (x, name, other) => (name in x ? x[name] : other),
    replace: (x, changes) => Object.assign(Object.create(Object.getPrototypeOf(x)), x, changes),
  };
})();
const math = { pi: Math.PI, floor: Math.floor, isfinite: Number.isFinite };
const MODULES = {};
