// What stands over the splat: boxes of answers, the ground grid, photos' frusta, and the robot.

import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Theme } from "../theme";
import type { Extent } from "./opening";
import type { Answer, Description, Photo, Vector } from "../network";

const ROBOT_COLOUR = 0x4fd1a5;
/** Of the robot that is drawn, and asked for places to stand: `/v1/goal`'s own default. */
export const ROBOT_RADIUS_M = 0.3;

const MAX_FRUSTA = 2000;
/** Four lines from its tip and four around its base. */
const POINTS_OF_FRUSTUM = 16;

/** A thing that changed, as it is listed and drawn. */
export interface Change {
  kind: "appeared" | "went" | "moved";
  id: string;
  box: { min: Vector; max: Vector };
  /** Where it was, if it moved. */
  from?: Vector;
  to: Vector;
}

const CHANGE_COLOURS = { appeared: 0x4fd17a, went: 0xe05a4e, moved: 0xf2b134 };
/** Chosen, and not chosen. */
const BOX_COLOURS: Record<Theme, [number, number]> = { dark: [0xffffff, 0x6fc8ff], light: [0x10141a, 0x0a5aa8], contrast: [0xffffff, 0x00e0ff] };
const GRID_COLOURS: Record<Theme, [number, number]> = { dark: [0x55606d, 0x353e48], light: [0x98a3af, 0xc3cad1], contrast: [0xffffff, 0x666666] };
const CELL_COLOURS = { on_board: 0x8593a3, stale: 0xd99a2b, missing: 0xe05a4e };

export function disposeAll(group: THREE.Group): void {
  group.traverse((object) => {
    if (!(object instanceof THREE.Mesh || object instanceof THREE.LineSegments)) return;
    object.geometry.dispose();
    (object.material as THREE.Material).dispose();
  });
  group.clear();
}

export class Marks {
  readonly boxes = new THREE.Group();
  readonly ground = new THREE.Group();
  readonly cells = new THREE.Group();
  readonly photos = new THREE.Group();
  readonly robot = new THREE.Group();
  readonly changes = new THREE.Group();
  private readonly measured = new THREE.Group();
  private photoPlaces: Vector[] = [];
  private photosNear: boolean[] = [];

  constructor(parent: THREE.Object3D) {
    this.photos.visible = this.cells.visible = false;
    this.photos.renderOrder = this.robot.renderOrder = 5;
    parent.add(this.boxes, this.ground, this.cells, this.photos, this.robot, this.changes, this.measured);
  }

  /**
   * Each box has a solid twin that is never drawn, for clicks. Only transparent things are drawn after the
   * splats.
   */
  showAnswers(answers: Answer[], opacities: number[], chosen: number | null, theme: Theme): void {
    disposeAll(this.boxes);
    answers.forEach((answer, index) => {
      const isChosen = index === chosen;
      if (chosen !== null && !isChosen) return;
      const box = boxOf(answer);
      const solid = new THREE.BoxGeometry(...box.size);
      const lines = new LineSegmentsGeometry().fromEdgesGeometry(new THREE.EdgesGeometry(solid));
      const edges = new LineSegments2(lines, new LineMaterial({
        color: BOX_COLOURS[theme][isChosen ? 0 : 1], linewidth: isChosen ? 2.5 : 1.5, depthTest: false, transparent: true,
        opacity: isChosen ? 1 : opacities[index],
      }));
      const target = new THREE.Mesh(solid, new THREE.MeshBasicMaterial({ colorWrite: false, depthWrite: false, side: THREE.DoubleSide }));
      target.userData.index = index;
      for (const object of [edges, target]) {
        object.position.set(...box.centre);
        object.quaternion.copy(box.rotation);
        object.renderOrder = 10;
        this.boxes.add(object);
      }
    });
  }

  /** Lines on the ground, a metre apart, or five, or ten; returns that. They are drawn before the splats, so only where there are none. */
  showGround({ box, groundM }: Extent, up: THREE.Vector3, isGeographic: boolean, theme: Theme): number {
    disposeAll(this.ground);
    const size = box.getSize(new THREE.Vector3()).length();
    const stepM = size > 200 ? 10 : size > 60 ? 5 : 1;
    const n = Math.min(200, Math.ceil((size * 1.2) / stepM / 2) * 2);
    const grid = new THREE.GridHelper(n * stepM, n, ...GRID_COLOURS[theme]);
    const centre = box.getCenter(new THREE.Vector3());
    this.ground.add(grid);
    if (isGeographic) this.ground.add(new THREE.ArrowHelper(new THREE.Vector3(0, 0, -1), new THREE.Vector3(), (n * stepM) / 2, 0xe05a4e));
    // Three's grid lies in x and z; its -z becomes the world's y, which is north where the scene is
    // geo-referenced.
    this.ground.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), up);
    this.ground.position.copy(centre).addScaledVector(up, groundM - centre.dot(up));
    return stepM;
  }

  /** Outlines of cells: grey on board, amber of an earlier generation, red missing. */
  showCells(cells: Description["cells"]): void {
    disposeAll(this.cells);
    for (const { box_m, state } of cells) {
      const box = new THREE.Box3(new THREE.Vector3(...box_m.min), new THREE.Vector3(...box_m.max));
      const lines = new THREE.Box3Helper(box, CELL_COLOURS[state]);
      (lines.material as THREE.LineBasicMaterial).transparent = true;
      this.cells.add(lines);
    }
  }

  /** Boxes of things that changed, coloured by the kind of change; a line leads from where one was that moved. */
  showChanges(changes: Change[]): void {
    disposeAll(this.changes);
    for (const { kind, box, from, to } of changes) {
      const [min, max] = [new THREE.Vector3(...box.min), new THREE.Vector3(...box.max)];
      const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(...max.clone().sub(min).toArray()));
      const material = new THREE.LineBasicMaterial({ color: CHANGE_COLOURS[kind], depthTest: false, transparent: true });
      const lines = new THREE.LineSegments(edges, material);
      lines.position.copy(min.add(max).multiplyScalar(0.5));
      lines.renderOrder = 11;
      this.changes.add(lines);
      if (!from) continue;
      const way = new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(...from), new THREE.Vector3(...to)]), material.clone());
      way.renderOrder = 11;
      this.changes.add(way);
    }
  }

  showPhotos(photos: Photo[], lengthM: number): void {
    disposeAll(this.photos);
    const points: THREE.Vector3[] = [];
    this.photosNear = [];
    this.photoPlaces = photos.slice(0, MAX_FRUSTA).map((photo) => photo.position_m);
    for (const photo of photos.slice(0, MAX_FRUSTA)) {
      const place = new THREE.Vector3(...photo.position_m);
      const rotation = new THREE.Quaternion(...photo.rotation_xyzw);
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
        new THREE.Vector3((x * photo.width_px) / 2 / photo.focal_px, (y * photo.height_px) / 2 / photo.focal_px, 1)
          .multiplyScalar(lengthM).applyQuaternion(rotation).add(place));
      corners.forEach((corner, i) => points.push(place, corner, corner, corners[(i + 1) % 4]));
    }
    this.photos.add(new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color: 0x6fbf8b, transparent: true })));
  }

  /** Leaves out the cameras that are this near to the eye. */
  hidePhotosNear(eye: Vector, leastM: number): void {
    const lines = this.photos.children[0];
    if (!(lines instanceof THREE.LineSegments)) return;
    const near = this.photoPlaces.map((place) => Math.hypot(...place.map((v, k) => v - eye[k])) < leastM);
    // A new index is a new buffer on the GPU.
    if (near.every((isNear, i) => isNear === this.photosNear[i])) return;
    this.photosNear = near;
    const index: number[] = [];
    near.forEach((isNear, i) => {
      for (let k = 0; k < POINTS_OF_FRUSTUM && !isNear; k++) index.push(i * POINTS_OF_FRUSTUM + k);
    });
    lines.geometry.dispose();
    lines.geometry.setIndex(index);
  }

  /** A cone that points where the robot heads, a post and a ring; and a ring around what it fetched. */
  showRobot({ position_m, fetched }: Description, headingRad: number | null, up: THREE.Vector3): void {
    disposeAll(this.robot);
    const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), up);
    const points: THREE.Vector3[] = [];
    const around = (centre: Vector, angle: number, radius: number, height = 0) =>
      new THREE.Vector3(Math.cos(angle) * radius, Math.sin(angle) * radius, height).applyQuaternion(turn).add(new THREE.Vector3(...centre));
    const ring = (centre: Vector, radius: number) => {
      for (let i = 0; i < 64; i++) for (const k of [i, i + 1]) points.push(around(centre, (k * Math.PI) / 32, radius));
    };
    if (fetched) ring(fetched.centre_m, fetched.radius_m);
    if (position_m) {
      const at = new THREE.Vector3(...position_m);
      points.push(at, at.clone().addScaledVector(up, 1));
      ring(position_m, ROBOT_RADIUS_M);
      if (headingRad !== null) {
        const nose = [around(position_m, headingRad, 3 * ROBOT_RADIUS_M), ...[1.3, -1.3].map((side) => around(position_m, headingRad + side, ROBOT_RADIUS_M))];
        const geometry = new THREE.BufferGeometry().setFromPoints(nose);
        this.robot.add(new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color: ROBOT_COLOUR, depthTest: false, transparent: true, side: THREE.DoubleSide })));
      }
    }
    if (points.length === 0) return;
    this.robot.add(new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color: ROBOT_COLOUR, transparent: true })));
  }

  /** The line that is measured: nothing, one end, or both. */
  showMeasured(points: Vector[]): void {
    disposeAll(this.measured);
    const [a, b] = points.map((point) => new THREE.Vector3(...point));
    if (!a || !b) return;
    const line = new LineSegments2(new LineSegmentsGeometry().setPositions([...a.toArray(), ...b.toArray()]), new LineMaterial({ color: 0xffffff, linewidth: 3, depthTest: false, transparent: true }));
    line.renderOrder = 12;
    this.measured.add(line);
  }
}

export function boxOf(answer: Answer): { centre: Vector; size: Vector; rotation: THREE.Quaternion } {
  const oriented = answer.oriented_box;
  if (oriented) return { centre: oriented.centre_in_world, size: oriented.size, rotation: new THREE.Quaternion(...oriented.rotation_world_from_box) };
  const [min, max] = [answer.box_min_in_world, answer.box_max_in_world];
  const combine = (f: (low: number, high: number) => number) => min.map((low, i) => f(low, max[i])) as Vector;
  return { centre: combine((low, high) => (low + high) / 2), size: combine((low, high) => high - low), rotation: new THREE.Quaternion() };
}

/** Where a photo shows an answer's box, and which share of the picture it takes; null where it shows less than half of it. */
export function seenBy(photo: Photo, answer: Answer): { boxPx: [number, number, number, number]; share: number } | null {
  const { centre, size, rotation } = boxOf(answer);
  const toCamera = new THREE.Quaternion(...photo.rotation_xyzw).invert();
  const middle = [photo.width_px / 2, photo.height_px / 2];
  const box = new THREE.Box2();
  for (let i = 0; i < 8; i++) {
    const corner = new THREE.Vector3(...(size.map((length, k) => ((i >> k) & 1 ? length : -length) / 2) as Vector)).applyQuaternion(rotation);
    const seen = corner.add(new THREE.Vector3(...centre)).sub(new THREE.Vector3(...photo.position_m)).applyQuaternion(toCamera);
    if (seen.z < 0.05) return null;
    box.expandByPoint(new THREE.Vector2(middle[0] + (seen.x / seen.z) * photo.focal_px, middle[1] + (seen.y / seen.z) * photo.focal_px));
  }
  const areaOf = (of: THREE.Box2) => (of.isEmpty() ? 0 : (of.max.x - of.min.x) * (of.max.y - of.min.y));
  const whole = areaOf(box);
  box.intersect(new THREE.Box2(new THREE.Vector2(), new THREE.Vector2(photo.width_px, photo.height_px)));
  if (areaOf(box) < whole / 2) return null;
  return { boxPx: [box.min.x, box.min.y, box.max.x, box.max.y], share: areaOf(box) / (photo.width_px * photo.height_px) };
}
