/** Which words two texts do not share. */

/** Cells of the table at most; beyond that only the beginnings are compared, so that no text stops the page. */
const CELLS = 4_000_000;
const WORD = /\s+|[\p{L}\p{N}_]+|[^\s\p{L}\p{N}_]/gu;

/** A text as words, runs of space, and single signs. */
export function words(text) {
  return text.match(WORD) ?? [];
}

/**
 * Two lists of runs {text, alone}: `alone` where the other text has no such words there.
 *
 * By the longest common subsequence of words, common ends aside. `whole` is false where the texts were too long to
 * be compared to their ends.
 */
export function compare(first, second) {
  const a = words(first);
  const b = words(second);
  const head = shared(a.length, b.length, (i) => a[i] === b[i]);
  const rest = Math.min(a.length, b.length) - head;
  const tail = shared(rest, rest, (i) => a[a.length - 1 - i] === b[b.length - 1 - i]);
  const left = a.slice(head, a.length - tail);
  const right = b.slice(head, b.length - tail);
  const [n, m, whole] = within(left.length, right.length);
  const common = subsequence(left.slice(0, n), right.slice(0, m));
  const kept = (length, taken) => [...Array(head).fill(true), ...pad(taken, length), ...Array(tail).fill(true)];
  return { first: runs(a, kept(left.length, common.left)), second: runs(b, kept(right.length, common.right)), whole };
}

function shared(n, m, same) {
  const limit = Math.min(n, m);
  let count = 0;
  while (count < limit && same(count)) count += 1;
  return count;
}

/** How many words of each side fit into the table. */
function within(n, m) {
  if (n * m <= CELLS) return [n, m, true];
  const side = Math.floor(Math.sqrt(CELLS));
  const short = Math.min(n, m, side);
  const long = Math.floor(CELLS / Math.max(1, short));
  return [...(n <= m ? [short, Math.min(m, long)] : [Math.min(n, long), short]), false];
}

/** What was not compared counts as shared: nothing is claimed of it. */
function pad(flags, length) {
  return [...flags, ...Array(length - flags.length).fill(true)];
}

/** Which words of each side belong to the longest common subsequence. */
function subsequence(a, b) {
  const width = b.length + 1;
  const length = new Uint16Array((a.length + 1) * width);
  for (let i = a.length - 1; i >= 0; i--) {
    for (let j = b.length - 1; j >= 0; j--) {
      const at = i * width + j;
      length[at] = a[i] === b[j] ? length[at + width + 1] + 1 : Math.max(length[at + width], length[at + 1]);
    }
  }
  return walk(a, b, length, width);
}

function walk(a, b, length, width) {
  const left = Array(a.length).fill(false);
  const right = Array(b.length).fill(false);
  let i = 0;
  let j = 0;
  while (i < a.length && j < b.length) {
    if (a[i] === b[j]) left[i++] = right[j++] = true;
    else if (length[(i + 1) * width + j] >= length[i * width + j + 1]) i += 1;
    else j += 1;
  }
  return { left, right };
}

/** Neighbours of one sort put together. */
function runs(list, kept) {
  const out = [];
  list.forEach((text, at) => {
    const alone = !kept[at];
    const last = out.at(-1);
    if (last && last.alone === alone) last.parts.push(text);
    else out.push({ alone, parts: [text] });
  });
  return out.map(({ alone, parts }) => ({ alone, text: parts.join("") }));
}
