// Colours of scores: dark red to pale yellow, and blues for a second question. Lit Gaussians keep some of their
// own colour, others turn grey.

const WARM = [[120, 28, 109], [187, 55, 84], [237, 105, 37], [252, 165, 10], [252, 255, 164]];
const COLD = [[22, 60, 140], [36, 104, 190], [63, 143, 214], [120, 190, 240], [200, 235, 255]];
const SHARE_OF_RAMP = 0.8;

/** Levels of a question's scores, and the level from which they are lit. */
export interface Lit {
  levels: Uint8Array;
  threshold: number;
}

export function rampColour(share: number, stops = WARM): [number, number, number] {
  const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const i = Math.min(Math.floor(at), stops.length - 2);
  const mix = (k: number) => Math.round(stops[i][k] + (stops[i + 1][k] - stops[i][k]) * (at - i));
  return [mix(0), mix(1), mix(2)];
}

const TABLES = [WARM, COLD].map((stops) => {
  const table = new Uint8Array(256 * 3);
  for (let step = 0; step < 256; step++) table.set(rampColour(step / 255, stops), 3 * step);
  return table;
});

/** For each level how far above the threshold it is, 0 to 255, or -1 below it. */
function sharesOf(lit: Lit | null): Int16Array {
  const threshold = Math.max(lit?.threshold ?? 256, 1);
  return Int16Array.from({ length: 256 }, (_, level) => (level >= threshold ? Math.round((255 * (level - threshold)) / Math.max(255 - threshold, 1)) : -1));
}

/**
 * Writes RGBA of Gaussians from their packed words. Where both questions light one, the one that is farther
 * above its threshold counts.
 */
export function colourByScore(rgba: Uint8Array, { packed, n, step }: { packed: Uint32Array; n: number; step: number }, first: Lit | null, second: Lit | null): void {
  const [ofFirst, ofSecond] = [sharesOf(first), sharesOf(second)];
  const none = new Uint8Array(0);
  const [firstLevels, secondLevels] = [first?.levels ?? none, second?.levels ?? none];
  for (let i = 0; i < n; i++) {
    const word = packed[4 * i];
    const r = word & 255;
    const g = (word >> 8) & 255;
    const b = (word >> 16) & 255;
    const a = first ? ofFirst[firstLevels[i * step]] : -1;
    const z = second ? ofSecond[secondLevels[i * step]] : -1;
    const best = Math.max(a, z);
    if (best >= 0) {
      const table = TABLES[a >= z ? 0 : 1];
      const at = 3 * best;
      rgba[4 * i] = r + (table[at] - r) * SHARE_OF_RAMP;
      rgba[4 * i + 1] = g + (table[at + 1] - g) * SHARE_OF_RAMP;
      rgba[4 * i + 2] = b + (table[at + 2] - b) * SHARE_OF_RAMP;
    } else {
      const grey = (0.3 * r + 0.59 * g + 0.11 * b) * 0.6 + 20;
      rgba[4 * i] = rgba[4 * i + 1] = rgba[4 * i + 2] = grey;
    }
    rgba[4 * i + 3] = word >>> 24;
  }
}
