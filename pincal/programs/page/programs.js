// Programs of controllers: their text as trees, by the same grammars as the command's, whose tables are written in GRAMMARS.

class Token {
  constructor(type, text, start_pos, line) { Object.assign(this, { type, text, start_pos, end_pos: start_pos + text.length, line }); }
  toString() { return this.text; }
}
class Tree {
  constructor(data, children) { this.data = data; this.children = children; }
}
const ProgramError = class extends Refused {}, BadInputError = class extends Refused {};
const LANGUAGES = { known: [], register(kind) { this.known.push(kind); } };

// One file of a program; its content is a string of bytes.
class Source {
  constructor(name, content) { this.name = name; this.content = content; }
  get text() {
    const zero = this.content.indexOf("\0");
    if (zero >= 0) throw this.error("a zero byte; expected text in ASCII, Latin-1 or UTF-8", zero);
    return this.content.startsWith("\xef\xbb\xbf") ? `   ${this.content.slice(3)}` : this.content;
  }
  place(at) {
    const before = this.content.slice(0, at).replace(/\r\n/g, " \n").replace(/\r/g, "\n");
    return [before.split("\n").length, at - before.lastIndexOf("\n")];
  }
  error(what, at) {
    const [line, column] = this.place(at);
    return new ProgramError(`${this.name}, line ${line}, column ${column}: ${what}`);
  }
  parse(grammar, words, part = null) {
    const text = part ? " ".repeat(part[0]) + this.text.slice(...part) : this.text, table = GRAMMARS[grammar];
    const fail = (at, found) => {
      at = Math.min(at, text.length);
      if (at === text.length) throw this.error(`the end of the file; expected more of ${words}: is it truncated?`, text.length);
      throw this.error(`${py.repr(found.slice(0, 30))}; expected ${words}`, at);
    };
    return parsed(table, `${text}\n\x04`, fail);
  }
  statements(tokens, words, over_lines = false) {
    const found = [], { Statement, place_of } = MODULES.syntax;
    for (const tree of this.parse(MODULES.syntax.nested(tokens, over_lines), words).children) {
      const items = this.items(tree.children, words);
      if (!items.length) continue;
      const [start, end] = place_of(items);
      found.push(new Statement(items, start, end, items[0].line ?? this.place(start)[0]));
    }
    return found;
  }
  items(children, words, depth = 0) {
    return children.map((child) => {
      if (child instanceof Token) return child;
      const [first, last] = [child.children[0], child.children[child.children.length - 1]], closing = { "(": ")", "[": "]", "{": "}" }[first.text];
      if (depth === 100) throw this.error(`brackets within 100 others; expected fewer in ${words}`, first.start_pos);
      if (closing !== last.text) throw this.error(`'${last.text}'; expected '${closing}' in ${words}`, last.start_pos);
      return new MODULES.syntax.Brackets(first.text, this.items(child.children.slice(1, -1), words, depth + 1), first.start_pos, last.end_pos);
    });
  }
}

// The tree of a text by an LALR table: states with what each terminal does, terminals in the order in which they are tried.
function parsed(table, text, fail) {
  const states = [table.start], values = [], shown = (token) => !token.type.startsWith("_") && !table.hidden.includes(token.type);
  const terminals = (table.compiled ??= table.terminals.map((pattern) => new RegExp(pattern, "y")));
  let at = 0, line = 1;
  const next = (state) => {
    for (;;) {
      if (at === text.length) return new Token("$END", "", at, line);
      const k = table.states[state].tried.find((i) => { terminals[i].lastIndex = at; return terminals[i].test(text) && terminals[i].lastIndex > at; });
      if (k === undefined) fail(at, text[at]);
      const token = new Token(table.names[k], text.slice(at, terminals[k].lastIndex), at, line);
      at = token.end_pos;
      line += token.text.split("\n").length - 1;
      if (!table.ignored.includes(token.type)) return token;
    }
  };
  for (let token = next(table.start); ;) {
    const state = states[states.length - 1], action = table.states[state].actions[token.type];
    if (action === undefined) fail(token.start_pos, token.text);
    if (action[0] === 0) {
      states.push(action[1]);
      values.push(token);
      token = next(action[1]);
      continue;
    }
    const [origin, size, data] = table.rules[action[1]], parts = size ? values.splice(-size) : [];
    if (size) states.splice(-size);
    const children = parts.flatMap((part) => (part instanceof Token ? (shown(part) ? [part] : []) : part.data.startsWith("_") ? part.children : [part]));
    const tree = new Tree(data, children), goto = table.states[states[states.length - 1]].actions[origin];
    if (goto === undefined || (token.type === "$END" && origin === "start")) return tree;
    states.push(goto[1]);
    values.push(tree);
  }
}
