// The binary messages of /v1/view, little-endian.

const WIDTH = 2048; // textures of splats are this wide, and arrays are padded to whole rows

export interface CellGaussians {
  n: number;
  /** Every `step`-th Gaussian of the cell was sent. */
  step: number;
  originM: [number, number, number];
  hasAppearance: boolean;
  /** Four words a Gaussian, as the renderer packs them. */
  packed: Uint32Array;
}

export interface Scores {
  min: number;
  max: number;
  /** Which generation they are of, modulo 2^32. */
  generation: number;
  /** By the cells' ids. */
  byCell: Map<number, Uint8Array>;
}

function open(buffer: ArrayBuffer, magic: string): DataView {
  const view = new DataView(buffer);
  if (buffer.byteLength < 24) throw new Error(`message ${magic}: ${buffer.byteLength} bytes is too short`);
  const found = String.fromCharCode(...new Uint8Array(buffer, 0, 4));
  if (found !== magic || view.getUint32(4, true) !== 1) {
    throw new Error(`expected message ${magic} version 1, found ${found} version ${view.getUint32(4, true)}; reload the page`);
  }
  return view;
}

/** Interleaves the columns centre, colour, opacity, scale and rotation. */
export function readCell(buffer: ArrayBuffer): CellGaussians {
  const view = open(buffer, "SLGG");
  const n = view.getUint32(8, true);
  if (buffer.byteLength !== 32 + 16 * n) throw new Error(`cell of ${n} Gaussians: expected ${32 + 16 * n} bytes, found ${buffer.byteLength}`);
  const centre = new Uint16Array(buffer, 32, 3 * n);
  const colour = new Uint8Array(buffer, 32 + 6 * n, 3 * n);
  const opacity = new Uint8Array(buffer, 32 + 9 * n, n);
  const scale = new Uint8Array(buffer, 32 + 10 * n, 3 * n);
  const rotation = new Uint8Array(buffer, 32 + 13 * n, 3 * n);
  const packed = new Uint32Array(Math.max(1, Math.ceil(n / WIDTH)) * WIDTH * 4);
  for (let i = 0; i < n; i++) {
    const k = 3 * i;
    packed[4 * i] = colour[k] | (colour[k + 1] << 8) | (colour[k + 2] << 16) | (opacity[i] << 24);
    packed[4 * i + 1] = centre[k] | (centre[k + 1] << 16);
    packed[4 * i + 2] = centre[k + 2] | (rotation[k] << 16) | (rotation[k + 1] << 24);
    packed[4 * i + 3] = scale[k] | (scale[k + 1] << 8) | (scale[k + 2] << 16) | (rotation[k + 2] << 24);
  }
  const originM: [number, number, number] = [view.getFloat32(12, true), view.getFloat32(16, true), view.getFloat32(20, true)];
  return { n, step: view.getUint32(28, true), originM, hasAppearance: (view.getUint32(24, true) & 1) === 1, packed };
}

export function readScores(buffer: ArrayBuffer): Scores {
  const view = open(buffer, "SLGS");
  const nCells = view.getUint32(16, true);
  let offset = 24 + 8 * nCells;
  if (offset > buffer.byteLength) throw new Error(`scores of ${nCells} cells: the message is cut off`);
  const byCell = new Map<number, Uint8Array>();
  for (let i = 0; i < nCells; i++) {
    const n = view.getUint32(28 + 8 * i, true);
    if (offset + n > buffer.byteLength) throw new Error("scores: the message is cut off");
    byCell.set(view.getUint32(24 + 8 * i, true), new Uint8Array(buffer, offset, n));
    offset += n;
  }
  return { min: view.getFloat32(8, true), max: view.getFloat32(12, true), generation: view.getUint32(20, true), byCell };
}
