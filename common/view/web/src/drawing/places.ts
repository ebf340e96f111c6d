// Places to stand: a robot's outline on the ground with a nose, and a thin line from its sensor to what it
// looks at.

import * as THREE from "three";
import type { Goal, Vector } from "../network";
import { disposeAll } from "./marks";

const COLOUR = 0xc77dff;
const CHOSEN = 0xffffff;
const SIDES = 32;

export class Places {
  readonly group = new THREE.Group();

  constructor(parent: THREE.Object3D) {
    this.group.renderOrder = 9;
    parent.add(this.group);
  }

  /** `radiusM`: of the robot. The ground lies across z (REP-103). */
  show(goals: Goal[], thing: Vector | null, radiusM: number, chosen: number | null): void {
    disposeAll(this.group);
    goals.forEach((goal, index) => {
      const centre = new THREE.Vector3(...goal.position_in_world);
      const at = (angle: number, share: number) =>
        new THREE.Vector3(Math.cos(angle), Math.sin(angle), 0).multiplyScalar(radiusM * share).add(centre);
      const outline: THREE.Vector3[] = [];
      for (let i = 0; i < SIDES; i++) for (const k of [i, i + 1]) outline.push(at((2 * Math.PI * k) / SIDES, 1));
      const colour = index === chosen ? CHOSEN : COLOUR;
      // The nose: a filled triangle, so that a pose can be told from a ring at any distance.
      const nose = [at(goal.yaw_rad, 1), at(goal.yaw_rad + 2.5, 0.8), at(goal.yaw_rad - 2.5, 0.8)];
      if (thing) outline.push(new THREE.Vector3(...goal.sensor_in_world), new THREE.Vector3(...thing));
      const material = { color: colour, depthTest: false, transparent: true };
      const lines = new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(outline), new THREE.LineBasicMaterial(material));
      const filled = new THREE.Mesh(new THREE.BufferGeometry().setFromPoints(nose), new THREE.MeshBasicMaterial({ ...material, side: THREE.DoubleSide }));
      lines.renderOrder = filled.renderOrder = 9;
      this.group.add(lines, filled);
    });
  }
}
