// One mesh of splats a cell, each around its own origin because centres are half floats.

import { PackedSplats, RgbaArray, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { CellGaussians, Scores } from "../messages";
import type { Answer, Vector } from "../network";
import { boxOf } from "./marks";
import { centreOf, type Hit, pick } from "./pick";
import { type Lit, colourByScore, type Palette } from "./ramp";

/** A question's scores, and the level from which they are lit: in the boxes of its answers, and elsewhere. */
export interface Question {
  scores: Scores;
  threshold: number;
  outside: number;
  answers: Answer[];
}

/** A thing's own Gaussians reach so much out of its box. */
const ROOM = 1.1;

/** Levels of a cell's Gaussians, 0 where they are lit in boxes alone and lie in none. */
function litOf({ threshold, outside, answers }: Question, levels: Uint8Array, gaussians: CellGaussians): Uint8Array {
  if (outside <= threshold) return levels;
  const boxes = answers.map((answer) => {
    const { centre, size, rotation } = boxOf(answer);
    return { centre: new THREE.Vector3(...centre), half: new THREE.Vector3(...size).multiplyScalar(ROOM / 2), turn: rotation.clone().invert() };
  });
  const lit = levels.slice();
  const [centre, point]: [Vector, THREE.Vector3] = [[0, 0, 0], new THREE.Vector3()];
  for (let i = 0; i < gaussians.n; i++) {
    const level = levels[i * gaussians.step];
    if (level < threshold || level >= outside) continue;
    centreOf(gaussians, i, centre);
    const isIn = boxes.some((box) => {
      point.set(...centre).sub(box.centre).applyQuaternion(box.turn);
      return Math.abs(point.x) <= box.half.x && Math.abs(point.y) <= box.half.y && Math.abs(point.z) <= box.half.z;
    });
    if (!isIn) lit[i * gaussians.step] = 0;
  }
  return lit;
}

interface Drawn {
  gaussians: CellGaussians;
  mesh: SplatMesh;
  rgba: RgbaArray | null;
}

export class Cells {
  private readonly drawn = new Map<number, Drawn>();
  private questions: [Question | null, Question | null] = [null, null];
  private palette: Palette | null = null;

  /** `box` holds the scene; where a cell has no colours, heights in it give shades. */
  constructor(private readonly parent: THREE.Object3D, private readonly box: THREE.Box3, private readonly up: THREE.Vector3) {}

  /** The step of a cell's Gaussians: 1 if all are drawn, null if the cell is not. */
  stepOf(cell: number): number | null {
    return this.drawn.get(cell)?.gaussians.step ?? null;
  }

  get nDrawn(): number {
    return [...this.drawn.values()].reduce((sum, cell) => sum + cell.gaussians.n, 0);
  }

  add(cell: number, gaussians: CellGaussians): void {
    this.remove(cell);
    if (!gaussians.hasAppearance) this.shadeByHeight(gaussians);
    const packedSplats = new PackedSplats({ packedArray: gaussians.packed, numSplats: gaussians.n });
    const mesh = new SplatMesh({ packedSplats });
    mesh.position.set(...gaussians.originM);
    this.parent.add(mesh);
    const drawn = { gaussians, mesh, rgba: null };
    this.drawn.set(cell, drawn);
    this.colourOne(cell, drawn);
  }

  remove(cell: number): void {
    const drawn = this.drawn.get(cell);
    if (!drawn) return;
    this.parent.remove(drawn.mesh);
    drawn.mesh.dispose();
    drawn.rgba?.dispose();
    this.drawn.delete(cell);
  }

  clear(): void {
    for (const cell of [...this.drawn.keys()]) this.remove(cell);
  }

  /** Centres of at most so many Gaussians of all that are drawn, in world metres. */
  points(most: number): Float64Array {
    const stride = Math.max(1, Math.ceil(this.nDrawn / most));
    const points: number[] = [];
    const centre: Vector = [0, 0, 0];
    for (const { gaussians } of this.drawn.values()) {
      for (let i = 0; i < gaussians.n; i += stride) {
        centreOf(gaussians, i, centre);
        points.push(...centre);
      }
    }
    return Float64Array.from(points);
  }

  /** All that are drawn, by cell. */
  *all(): Generator<[number, CellGaussians]> {
    for (const [cell, { gaussians }] of this.drawn) yield [cell, gaussians];
  }

  /** The Gaussian under a ray, and its score in the first question. */
  pick(from: Vector, along: Vector, pxRad: number): (Hit & { score: number | null }) | null {
    const hit = pick(this.all(), from, along, pxRad);
    if (!hit) return null;
    const scores = this.questions[0]?.scores;
    const level = scores?.byCell.get(hit.cell)?.[hit.index * (this.stepOf(hit.cell) ?? 1)];
    return { ...hit, score: scores && level ? scores.min + (level / 255) * (scores.max - scores.min) : null };
  }

  /** Colours again, in another palette. */
  paint(palette: Palette): void {
    this.palette = palette;
    this.colour(...this.questions);
  }

  /** Colours by one question or two; by none, the scene has its own colours again. */
  colour(first: Question | null, second: Question | null): void {
    this.questions = [first, second];
    for (const [cell, drawn] of this.drawn) this.colourOne(cell, drawn);
  }

  /** Without colours, heights give shades: high is light. */
  private shadeByHeight({ packed, n, originM }: CellGaussians): void {
    const heights = [this.box.min, this.box.max].map((corner) => corner.dot(this.up));
    const [low, high] = [Math.min(...heights), Math.max(...heights)];
    const origin = new THREE.Vector3(...originM).dot(this.up);
    const { fromHalfFloat } = THREE.DataUtils;
    for (let i = 0; i < n; i++) {
      const [xy, z] = [packed[4 * i + 1], packed[4 * i + 2]];
      const height = origin + fromHalfFloat(xy & 0xffff) * this.up.x + fromHalfFloat(xy >>> 16) * this.up.y + fromHalfFloat(z & 0xffff) * this.up.z;
      const grey = Math.round(80 + 130 * Math.min(Math.max((height - low) / (high - low || 1), 0), 1));
      packed[4 * i] = (packed[4 * i] & 0xff000000) | (grey << 16) | (grey << 8) | grey;
    }
  }

  private colourOne(cell: number, drawn: Drawn): void {
    const { gaussians, mesh } = drawn;
    if (this.questions.every((question) => question === null)) {
      if (mesh.splatRgba === null) return;
      mesh.splatRgba = null;
      mesh.updateGenerator();
      return;
    }
    const lit = (question: Question | null): Lit | null => {
      const found = question?.scores.byCell.get(cell);
      const isOfCell = found && Math.ceil(found.length / gaussians.step) === gaussians.n;
      return question && isOfCell ? { levels: litOf(question, found, gaussians), threshold: question.threshold } : null;
    };
    drawn.rgba ??= new RgbaArray({ array: new Uint8Array(gaussians.packed.length), count: gaussians.n });
    const array = drawn.rgba.array;
    if (!array || !this.palette) return;
    colourByScore(array, gaussians, lit(this.questions[0]), lit(this.questions[1]), this.palette);
    drawn.rgba.needsUpdate = true;
    if (mesh.splatRgba === null) {
      mesh.splatRgba = drawn.rgba;
      mesh.updateGenerator();
    }
    mesh.updateVersion();
  }
}
