// DEFLATE (RFC 1951) of text in base 85, so that what is packed in the page is there when it opens.

// codes of a Huffman tree from the lengths of its symbols: counts by length, symbols in order
function huffman(lengths) {
  const counts = new Uint16Array(16), starts = new Uint16Array(17), symbols = [];
  for (const length of lengths) counts[length] += 1;
  counts[0] = 0;
  for (let i = 1; i < 16; i += 1) starts[i + 1] = starts[i] + counts[i];
  lengths.forEach((length, symbol) => {
    if (length) symbols[starts[length]++] = symbol;
  });
  return { counts, symbols };
}

// {base, extra} of the codes of lengths and distances; every `step` codes have one more bit
function ranges(count, first, step) {
  const base = [], extra = [];
  for (let i = 0, at = first; i < count; i += 1) {
    extra[i] = Math.max(0, Math.floor(i / step) - 1);
    base[i] = at;
    at += 1 << extra[i];
  }
  return { base, extra };
}

const DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%,()*+-;.=:?@^_[{|}~";

// four bytes of five digits, those of page.py
function bytesOf(text) {
  const value = new Uint8Array(128).fill(84), out = new Uint8Array(Math.floor((4 * text.length) / 5));
  for (let i = 0; i < 85; i += 1) value[DIGITS.charCodeAt(i)] = i;
  for (let i = 0, o = 0; i < text.length; i += 5, o += 4) {
    let four = 0;
    for (let j = 0; j < 5; j += 1) four = 85 * four + (i + j < text.length ? value[text.charCodeAt(i + j)] : 84);
    for (let k = 3; k >= 0; k -= 1, four = Math.floor(four / 256)) out[o + k] = four % 256;
  }
  return out;
}

function inflate(text) {
  const source = bytesOf(text);
  const lengths = ranges(29, 3, 4), distances = ranges(30, 1, 2);
  lengths.base[28] = 258;
  lengths.extra[28] = 0;
  let bit = 0, out = new Uint8Array(4 * source.length + 1024), end = 0;
  const bits = (n) => {
    let value = 0;
    for (let i = 0; i < n; i += 1, bit += 1) value |= ((source[bit >> 3] >> (bit & 7)) & 1) << i;
    return value;
  };
  const symbol = ({ counts, symbols }) => {
    for (let length = 1, code = 0, first = 0, index = 0; length < 16; length += 1) {
      code |= bits(1);
      const count = counts[length];
      if (code - count < first) return symbols[index + code - first];
      index += count;
      first = (first + count) << 1;
      code <<= 1;
    }
    throw new Error("damaged text");
  };
  const put = (byte) => {
    if (end === out.length) {
      const larger = new Uint8Array(2 * end);
      larger.set(out);
      out = larger;
    }
    out[end++] = byte;
  };
  const trees = () => {
    const literals = bits(5) + 257, count = literals + bits(5) + 1, own = bits(4) + 4;
    const order = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
    const short = new Array(19).fill(0), all = [];
    for (let i = 0; i < own; i += 1) short[order[i]] = bits(3);
    const tree = huffman(short);
    while (all.length < count) {
      const code = symbol(tree);
      if (code < 16) all.push(code);
      else {
        const again = code === 16 ? 3 + bits(2) : code === 17 ? 3 + bits(3) : 11 + bits(7);
        const value = code === 16 ? all[all.length - 1] : 0;
        for (let i = 0; i < again; i += 1) all.push(value);
      }
    }
    return [huffman(all.slice(0, literals)), huffman(all.slice(literals))];
  };
  const fixed = () => [
    huffman(Array.from({ length: 288 }, (_, i) => (i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8))),
    huffman(new Array(30).fill(5)),
  ];
  for (let last = 0; !last; ) {
    last = bits(1);
    const kind = bits(2);
    if (kind === 0) {
      bit = (bit + 7) & ~7;
      const size = bits(16);
      bits(16);
      for (let i = 0; i < size; i += 1) put(bits(8));
      continue;
    }
    const [literal, distance] = kind === 1 ? fixed() : trees();
    for (let code = symbol(literal); code !== 256; code = symbol(literal)) {
      if (code < 256) {
        put(code);
        continue;
      }
      const length = lengths.base[code - 257] + bits(lengths.extra[code - 257]);
      const own = symbol(distance);
      const back = distances.base[own] + bits(distances.extra[own]);
      for (let i = 0; i < length; i += 1) put(out[end - back]);
    }
  }
  return new TextDecoder().decode(out.subarray(0, end));
}
