// Where the scene is, without its strays, and from where it is looked at first: along a photo's pose inside of
// it, or from above a survey.

import * as THREE from "three";
import type { Description, Photo, Vector } from "../network";

/** Share of the Gaussians left out on either side of each axis. */
const STRAYS = 0.02;
/** Least height and largest breadth of a scene that one stands in where no photos tell. */
const [ROOM_HEIGHT_M, ROOM_BREADTH_M] = [2, 40];
const EYE_M = 1.5;
const MAX_PHOTOS = 64;
/** A coarse picture of a candidate. */
const [COLUMNS, ROWS] = [18, 12];
const SLOPE_ABOVE = 0.8;

export interface Extent {
  box: THREE.Box3;
  /** Height of the ground along the scene's up. */
  groundM: number;
}

export interface Pose {
  position: THREE.Vector3;
  target: THREE.Vector3;
}

/** Points that stand for the cells until their Gaussians are here. */
export function pointsOfCells(cells: Description["cells"]): Float64Array {
  const shares = [0.1, 0.3, 0.5, 0.7, 0.9];
  const total = cells.reduce((sum, { n_gaussians }) => sum + n_gaussians, 0);
  const points: number[] = [];
  for (const { n_gaussians, box_m: { min, max } } of cells) {
    for (let i = 0; i < Math.round((400 * n_gaussians) / Math.max(total, 1)); i++) {
      const share = (k: number) => shares[(i * (k + 1) + k) % shares.length];
      points.push(...min.map((low, k) => low + (max[k] - low) * share(k)));
    }
  }
  return Float64Array.from(points);
}

/** The 2nd to 98th percentile along each axis, and the lowest height at which much lies. */
export function extentOf(points: Float64Array, up: THREE.Vector3): Extent | null {
  const n = points.length / 3;
  if (n === 0) return null;
  const between = (values: Float64Array) => {
    values.sort();
    return [values[Math.floor(STRAYS * (n - 1))], values[Math.ceil((1 - STRAYS) * (n - 1))]];
  };
  const box = new THREE.Box3();
  for (const axis of [0, 1, 2]) {
    const [low, high] = between(Float64Array.from({ length: n }, (_, i) => points[3 * i + axis]));
    box.min.setComponent(axis, low);
    box.max.setComponent(axis, high);
  }
  const heights = Float64Array.from({ length: n }, (_, i) => points[3 * i] * up.x + points[3 * i + 1] * up.y + points[3 * i + 2] * up.z);
  const [low, high] = between(heights);
  const bins = new Float64Array(60);
  for (const height of heights) bins[Math.floor((59.999 * (height - low)) / (high - low || 1))]++;
  const level = bins.findIndex((count) => count >= 0.5 * Math.max(...bins));
  return { box, groundM: low + ((level + 0.5) * (high - low)) / 60 };
}

/** Squares in which the ground is measured: a fortieth of the scene, and two around each. */
const [SQUARES, LEAST_SQUARE, LARGEST_SQUARE_M] = [40, 0.5, 2.5];
/** Share of what lies around a place that is below its ground. */
const BELOW_GROUND = 0.1;

/** The height of the ground by place: it need not be level. */
export class Ground {
  private readonly heights = new Map<string, number[]>();
  private readonly side: number;
  private readonly axes: [THREE.Vector3, THREE.Vector3];

  constructor(points: Float64Array, private readonly extent: Extent, up: THREE.Vector3) {
    const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), up);
    this.axes = [new THREE.Vector3(1, 0, 0).applyQuaternion(turn), new THREE.Vector3(0, 1, 0).applyQuaternion(turn)];
    this.side = Math.min(Math.max(extent.box.getSize(new THREE.Vector3()).length() / SQUARES, LEAST_SQUARE), LARGEST_SQUARE_M);
    const point = new THREE.Vector3();
    for (let i = 0; i < points.length; i += 3) {
      point.fromArray(points, i);
      const key = this.squareOf(point).join(",");
      const heights = this.heights.get(key);
      if (heights) heights.push(point.dot(up));
      else this.heights.set(key, [point.dot(up)]);
    }
  }

  private squareOf(point: THREE.Vector3): [number, number] {
    return this.axes.map((axis) => Math.floor(point.dot(axis) / this.side)) as [number, number];
  }

  under(point: THREE.Vector3): number {
    const [x, y] = this.squareOf(point);
    const around = Array.from({ length: 9 }, (_, i) => this.heights.get(`${x + (i % 3) - 1},${y + Math.floor(i / 3) - 1}`) ?? []).flat();
    return around.length === 0 ? this.extent.groundM : around.sort((a, b) => a - b)[Math.floor(BELOW_GROUND * around.length)];
  }
}

interface Candidate {
  position: THREE.Vector3;
  forward: THREE.Vector3;
}

/** How much of a view is filled, and how far it reaches: 0 to 1. */
function worthOf({ position, forward }: Candidate, points: Float64Array, up: THREE.Vector3, reachM: number): number {
  const right = forward.clone().cross(up).normalize();
  const over = right.clone().cross(forward);
  const depths = new Float64Array(COLUMNS * ROWS);
  for (let i = 0; i < points.length; i += 3) {
    const [x, y, z] = [points[i] - position.x, points[i + 1] - position.y, points[i + 2] - position.z];
    const depth = x * forward.x + y * forward.y + z * forward.z;
    if (depth < 0.05) continue;
    const column = Math.floor((0.5 + (x * right.x + y * right.y + z * right.z) / depth / 1.4) * COLUMNS);
    const row = Math.floor((0.5 - (x * over.x + y * over.y + z * over.z) / depth / 1.04) * ROWS);
    if (column < 0 || row < 0 || column >= COLUMNS || row >= ROWS) continue;
    const at = row * COLUMNS + column;
    if (depths[at] === 0 || depth < depths[at]) depths[at] = depth;
  }
  const reached = depths.reduce((sum, depth) => sum + Math.min(depth, reachM), 0) / depths.length / reachM;
  const tilt = Math.abs(forward.dot(up) + 0.15);
  return reached * Math.max(1 - 1.3 * tilt, 0.05);
}

const forwardOf = ({ rotation_xyzw }: Photo) => new THREE.Vector3(0, 0, 1).applyQuaternion(new THREE.Quaternion(...rotation_xyzw));
const vector = (point: Vector) => new THREE.Vector3(...point);

/** Poses to look from: the photos', or a few at the robot's or all over a room. */
function candidates({ views, position_m }: Description, { box, groundM }: Extent, up: THREE.Vector3): Candidate[] {
  const stride = Math.ceil(views.length / MAX_PHOTOS);
  if (views.length > 0) return views.filter((_, i) => i % stride === 0).map((photo) => ({ position: vector(photo.position_m), forward: forwardOf(photo) }));
  const shares = [0.2, 0.4, 0.6, 0.8];
  const size = box.getSize(new THREE.Vector3());
  const places = position_m ? [vector(position_m)] : shares.flatMap((x) => shares.map((y) => box.min.clone().add(size.clone().multiply(new THREE.Vector3(x, y, 0)))));
  const turn = new THREE.Quaternion();
  return places.flatMap((place) => [0, 1, 2, 3, 4, 5, 6, 7].map((k) => {
    place.addScaledVector(up, groundM + EYE_M - place.dot(up));
    const forward = new THREE.Vector3(1, 0, 0).applyQuaternion(turn.setFromUnitVectors(new THREE.Vector3(0, 0, 1), up)).applyAxisAngle(up, (k * Math.PI) / 4);
    return { position: place, forward: forward.addScaledVector(up, -0.2).normalize() };
  }));
}

/** `aspect`: breadth by height of the free part of the picture; `halfTan`: tangent of half its height's angle. */
function above({ box, groundM }: Extent, up: THREE.Vector3, aspect: number, halfTan: number): Pose {
  const target = box.getCenter(new THREE.Vector3());
  target.addScaledVector(up, groundM - target.dot(up));
  const size = box.getSize(new THREE.Vector3());
  const [breadth, depth] = [size.x, size.y].map((length) => Math.max(length, 0.5));
  // As wide as the picture, or as high where it looks longer; the edges of a survey are ragged anyway.
  const distance = Math.min(breadth / aspect, (depth * SLOPE_ABOVE) / 0.9) / 2 / halfTan;
  const south = new THREE.Vector3(0, -1, 0).addScaledVector(up, up.y).normalize();
  const away = south.multiplyScalar(Math.sqrt(1 - SLOPE_ABOVE ** 2)).addScaledVector(up, SLOPE_ABOVE);
  return { position: target.clone().addScaledVector(away, distance), target };
}

/** The opening view. */
export function openingPose(description: Description, points: Float64Array, extent: Extent, up: THREE.Vector3, aspect: number, halfTan: number): Pose {
  const { box, groundM } = extent;
  const size = box.getSize(new THREE.Vector3());
  const isInside = (place: THREE.Vector3) => box.clone().expandByScalar(0.1 * size.length()).containsPoint(place);
  const top = Math.max(box.min.dot(up), box.max.dot(up));
  const all = candidates(description, extent, up);
  const stood = description.views.length > 0 ? all.filter(({ position }) => isInside(position) && position.dot(up) < top)
    : top - groundM > ROOM_HEIGHT_M && Math.hypot(size.x, size.y) < ROOM_BREADTH_M ? all : [];
  if (stood.length * 2 < all.length || stood.length === 0) return above(extent, up, aspect, halfTan);
  const reachM = 0.4 * size.length();
  const best = stood.map((candidate) => ({ candidate, worth: worthOf(candidate, points, up, reachM) })).reduce((a, b) => (b.worth > a.worth ? b : a)).candidate;
  return { position: best.position, target: best.position.clone().addScaledVector(best.forward, 0.5 * reachM) };
}
