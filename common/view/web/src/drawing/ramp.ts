// Colours of scores, dark red to pale yellow; lit Gaussians keep some of their own colour, others turn grey.

const STOPS = [[120, 28, 109], [187, 55, 84], [237, 105, 37], [252, 165, 10], [252, 255, 164]];
const SHARE_OF_RAMP = 0.8;

export function rampColour(share: number): [number, number, number] {
  const at = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
  const i = Math.min(Math.floor(at), STOPS.length - 2);
  const mix = (k: number) => Math.round(STOPS[i][k] + (STOPS[i + 1][k] - STOPS[i][k]) * (at - i));
  return [mix(0), mix(1), mix(2)];
}

/** Writes RGBA of `n` Gaussians from their packed words and score levels. */
export function colourByScore(rgba: Uint8Array, packed: Uint32Array, n: number, levels: Uint8Array, threshold: number): void {
  const table = new Uint8Array(256 * 3);
  for (let level = 0; level < 256; level++) table.set(rampColour((level - threshold) / Math.max(255 - threshold, 1)), 3 * level);
  for (let i = 0; i < n; i++) {
    const word = packed[4 * i];
    const r = word & 255;
    const g = (word >> 8) & 255;
    const b = (word >> 16) & 255;
    const level = levels[i];
    if (level >= threshold && level > 0) {
      rgba[4 * i] = r + (table[3 * level] - r) * SHARE_OF_RAMP;
      rgba[4 * i + 1] = g + (table[3 * level + 1] - g) * SHARE_OF_RAMP;
      rgba[4 * i + 2] = b + (table[3 * level + 2] - b) * SHARE_OF_RAMP;
    } else {
      const grey = (0.3 * r + 0.59 * g + 0.11 * b) * 0.6 + 20;
      rgba[4 * i] = rgba[4 * i + 1] = rgba[4 * i + 2] = grey;
    }
    rgba[4 * i + 3] = word >>> 24;
  }
}
