// What stands over the splat: boxes of answers, the ground grid, photos' frusta, and the robot.

import * as THREE from "three";
import type { Answer, Description, Photo, Vector } from "../network";

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

  constructor(parent: THREE.Object3D) {
    this.photos.visible = this.cells.visible = false;
    this.photos.renderOrder = this.robot.renderOrder = 5;
    parent.add(this.boxes, this.ground, this.cells, this.photos, this.robot, this.changes);
  }

  /**
   * Each box has a solid twin that is never drawn, for clicks. Only transparent things are drawn after the
   * splats.
   */
  showAnswers(answers: Answer[], chosen: number | null): void {
    disposeAll(this.boxes);
    answers.forEach((answer, index) => {
      const box = boxOf(answer);
      const solid = new THREE.BoxGeometry(...box.size);
      const colour = index === chosen ? 0xffffff : 0x58c4ff;
      const edges = new THREE.LineSegments(new THREE.EdgesGeometry(solid), new THREE.LineBasicMaterial({ color: colour, depthTest: false, transparent: true }));
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

  /** Lines a metre apart, or ten, on the plane under everything. */
  showGround(box: THREE.Box3, up: THREE.Vector3, isGeographic: boolean, isDark: boolean): number {
    disposeAll(this.ground);
    const size = box.getSize(new THREE.Vector3()).length();
    const stepM = size > 200 ? 10 : 1;
    const n = Math.min(200, Math.ceil((size * 1.2) / stepM / 2) * 2);
    const grid = new THREE.GridHelper(n * stepM, n, isDark ? 0x4a5563 : 0xa7b1bc, isDark ? 0x2a313a : 0xd2d8de);
    const centre = box.getCenter(new THREE.Vector3());
    const lowest = [box.min, box.max].map((corner) => corner.clone().sub(centre).dot(up)).reduce((a, b) => Math.min(a, b));
    this.ground.add(grid);
    if (isGeographic) this.ground.add(new THREE.ArrowHelper(new THREE.Vector3(0, 0, -1), new THREE.Vector3(), (n * stepM) / 2, 0xe05a4e));
    // Three's grid lies in x and z; its -z becomes the world's y, which is north where the scene is
    // geo-referenced.
    this.ground.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), up);
    this.ground.position.copy(centre).addScaledVector(up, lowest);
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
    for (const photo of photos.slice(0, 2000)) {
      const place = new THREE.Vector3(...photo.position_m);
      const rotation = new THREE.Quaternion(...photo.rotation_xyzw);
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
        new THREE.Vector3((x * photo.width_px) / 2 / photo.focal_px, (y * photo.height_px) / 2 / photo.focal_px, 1)
          .multiplyScalar(lengthM).applyQuaternion(rotation).add(place));
      corners.forEach((corner, i) => points.push(place, corner, corner, corners[(i + 1) % 4]));
    }
    this.photos.add(new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color: 0x6fbf8b, transparent: true })));
  }

  /** A post where the robot is, and a ring around what it fetched. */
  showRobot({ position_m, fetched }: Description, up: THREE.Vector3): void {
    disposeAll(this.robot);
    const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), up);
    const points: THREE.Vector3[] = [];
    const ring = (centre: Vector, radius: number) => {
      for (let i = 0; i < 64; i++) {
        for (const angle of [i, i + 1].map((k) => (k * Math.PI) / 32)) {
          points.push(new THREE.Vector3(Math.cos(angle) * radius, Math.sin(angle) * radius, 0).applyQuaternion(turn).add(new THREE.Vector3(...centre)));
        }
      }
    };
    if (fetched) ring(fetched.centre_m, fetched.radius_m);
    if (position_m) {
      const at = new THREE.Vector3(...position_m);
      points.push(at, at.clone().addScaledVector(up, 1));
      ring(position_m, 0.3);
    }
    if (points.length === 0) return;
    this.robot.add(new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color: 0x4fd1a5, transparent: true })));
  }
}

export function boxOf(answer: Answer): { centre: Vector; size: Vector; rotation: THREE.Quaternion } {
  const oriented = answer.oriented_box;
  if (oriented) return { centre: oriented.centre_in_world, size: oriented.size, rotation: new THREE.Quaternion(...oriented.rotation_world_from_box) };
  const [min, max] = [answer.box_min_in_world, answer.box_max_in_world];
  const combine = (f: (low: number, high: number) => number) => min.map((low, i) => f(low, max[i])) as Vector;
  return { centre: combine((low, high) => (low + high) / 2), size: combine((low, high) => high - low), rotation: new THREE.Quaternion() };
}
