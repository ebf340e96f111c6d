// Colours of scores. What is lit is bright on a dark scene, or dark on a pale one: lightness alone tells the two
// apart, for eyes that see no colours. The first question is orange, a second one blue.

import type { Theme } from "../theme";

type Stop = [number, number, number];

export interface Palette {
  warm: Stop[];
  cold: Stop[];
  /** Unlit Gaussians: their lightness times the first, plus the second. */
  unlit: [number, number];
}

export const PALETTES: Record<Theme, Palette> = {
  dark: { warm: [[255, 138, 30], [255, 176, 46], [255, 236, 140]], cold: [[70, 160, 255], [120, 190, 255], [205, 232, 255]], unlit: [0.3, 10] },
  light: { warm: [[196, 72, 0], [160, 40, 0], [96, 8, 8]], cold: [[0, 98, 200], [0, 70, 160], [0, 34, 100]], unlit: [0.28, 178] },
  contrast: { warm: [[255, 220, 0], [255, 240, 90], [255, 255, 190]], cold: [[0, 200, 255], [110, 225, 255], [210, 246, 255]], unlit: [0.22, 6] },
};
/** A lit Gaussian's share of the ramp; the rest is its own colour, which shows its shape. */
const SHARE_OF_RAMP = 0.8;
/** Share of its own tint that an unlit Gaussian keeps. */
const KEPT_TINT = 0.35;

/** Levels of a question's scores, and the level from which they are lit. */
export interface Lit {
  levels: Uint8Array;
  threshold: number;
}

export function rampColour(share: number, stops: Stop[]): Stop {
  const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const i = Math.min(Math.floor(at), stops.length - 2);
  const mix = (k: number) => Math.round(stops[i][k] + (stops[i + 1][k] - stops[i][k]) * (at - i));
  return [mix(0), mix(1), mix(2)];
}

function tableOf(stops: Stop[]): Uint8Array {
  const table = new Uint8Array(256 * 3);
  for (let step = 0; step < 256; step++) table.set(rampColour(step / 255, stops), 3 * step);
  return table;
}

/** For each level how far above the threshold it is, 0 to 255, or -1 below it. */
function sharesOf(lit: Lit | null): Int16Array {
  const threshold = Math.max(lit?.threshold ?? 256, 1);
  return Int16Array.from({ length: 256 }, (_, level) => (level >= threshold ? Math.round((255 * (level - threshold)) / Math.max(255 - threshold, 1)) : -1));
}

/**
 * Writes RGBA of Gaussians from their packed words. Where both questions light one, the one that is farther
 * above its threshold counts.
 */
export function colourByScore(rgba: Uint8Array, { packed, n, step }: { packed: Uint32Array; n: number; step: number }, first: Lit | null, second: Lit | null, palette: Palette): void {
  const [ofFirst, ofSecond] = [sharesOf(first), sharesOf(second)];
  const tables = [tableOf(palette.warm), tableOf(palette.cold)];
  const [scale, offset] = palette.unlit;
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
      const table = tables[a >= z ? 0 : 1];
      const at = 3 * best;
      rgba[4 * i] = r + (table[at] - r) * SHARE_OF_RAMP;
      rgba[4 * i + 1] = g + (table[at + 1] - g) * SHARE_OF_RAMP;
      rgba[4 * i + 2] = b + (table[at + 2] - b) * SHARE_OF_RAMP;
    } else {
      const grey = 0.3 * r + 0.59 * g + 0.11 * b;
      const dim = grey * scale + offset;
      const tint = scale * KEPT_TINT;
      rgba[4 * i] = dim + (r - grey) * tint;
      rgba[4 * i + 1] = dim + (g - grey) * tint;
      rgba[4 * i + 2] = dim + (b - grey) * tint;
    }
    rgba[4 * i + 3] = word >>> 24;
  }
}
