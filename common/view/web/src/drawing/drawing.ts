// The picture: splats, marks over them and labels, drawn only when something changed.

import { SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { Answer, Description, Goal, Photo, Vector } from "../network";
import type { Theme } from "../theme";
import { Camera, FIELD_OF_VIEW_DEG } from "./camera";
import { Cells } from "./cells";
import { Frames } from "./frames";
import { Hud } from "./hud";
import { boxOf, type Change, Marks, seenBy } from "./marks";
import { type Extent, extentOf, Ground, openingPose, pointsOfCells } from "./opening";
import { lightAlong } from "./pick";
import { Places } from "./places";
import { PALETTES } from "./ramp";

const MAX_LABELS = 9;
/** Arrows to what is out of view stand so far from the edge. */
const MARGIN_PX = 26;
const EDGE_PX = 6;
/** Largest distance between a click and the mark it means. */
const NEAR_PX = 14;
const BACKGROUNDS: Record<Theme, number> = { dark: 0x14181d, light: 0xeceff2, contrast: 0x000000 };
/** Points by which the extent is measured. */
const N_POINTS = 20_000;
/** Cameras of photos nearer than this would fill the picture with their lines. */
const NEAR_EYE_M = 1;
/** Share of the light by which a photo sees a thing, through haze. */
const LEAST_LIGHT = 0.3;
/** Photos that are tried for one that nothing hides. */
const MOST_RAYS = 6;
/** Gaussians that are looked at for that. */
const MOST_ON_A_RAY = 150_000;
/** The picture's half height has so many radii of an answer: as its photo shows it, and otherwise. */
const [ROOM_IN_PHOTO, ROOM_AROUND] = [2.2, 3];

interface Label {
  text: string;
  at: Vector;
  kind: string;
}

export class Drawing {
  readonly camera: Camera;
  readonly cells: Cells;
  readonly marks: Marks;
  readonly places: Places;
  /** Side of a square of the grid. */
  stepM = 1;
  extent: Extent;
  private ground: Ground | null = null;
  private readonly renderer: THREE.WebGLRenderer;
  private readonly scene = new THREE.Scene();
  /**
   * Holds everything in world metres, moved so that the scene's middle is at the origin: the GPU has 32-bit
   * floats.
   */
  private readonly world = new THREE.Group();
  private readonly up: THREE.Vector3;
  private readonly hud: Hud;
  private theme: Theme = "dark";
  private readonly labelled = { answers: [] as Label[], second: [] as Label[], robot: [] as Label[], measured: [] as Label[] };
  private shown: [Answer[], number[], number | null] = [[], [], null];
  private robotSeen = "";
  private isDirty = true;
  /** Where the camera was when it stood still. */
  private stood = "";
  private readonly frames: Frames;
  private waiting: (() => void)[] = [];

  /** `onStill` is called when the camera stops elsewhere; `onSlow` is told which share of the Gaussians would be drawn fast enough; `covered` what lies over the picture. */
  constructor(private readonly canvas: HTMLCanvasElement, private readonly labels: HTMLElement, private readonly description: Description,
    onLeavePhoto: () => void, private readonly onStill: () => void, onSlow: (share: number) => void, private readonly covered: () => [number, number]) {
    this.frames = new Frames(onSlow);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.up = new THREE.Vector3(...description.up).normalize();
    const somewhere = { box: new THREE.Box3(new THREE.Vector3(-1, -1, -1), new THREE.Vector3(1, 1, 1)), groundM: 0 };
    this.extent = extentOf(pointsOfCells(description.cells), this.up) ?? somewhere;
    this.world.position.copy(this.extent.box.getCenter(new THREE.Vector3())).negate();
    this.scene.add(new SparkRenderer({ renderer: this.renderer, onDirty: () => this.redraw() }), this.world);
    this.cells = new Cells(this.world, this.extent.box, this.up);
    this.marks = new Marks(this.world);
    this.places = new Places(this.world);
    this.hud = new Hud(this.up, description.metric, description.geographic);
    this.camera = new Camera(canvas, this.up, () => this.redraw(), onLeavePhoto);
    this.marks.showCells(description.cells);
    this.marks.showPhotos(description.views, this.radiusM / 40);
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    this.showOpening(true);
    this.renderer.setAnimationLoop((nowMs) => this.step(nowMs));
  }

  redraw(): void {
    this.isDirty = true;
  }

  /** Calls back once, after the next frame. */
  onceDrawn(then: () => void): void {
    this.waiting.push(then);
    this.redraw();
  }

  setTheme(theme: Theme): void {
    this.theme = theme;
    this.scene.background = new THREE.Color(BACKGROUNDS[theme]);
    this.cells.paint(PALETTES[theme]);
    this.showGround();
    this.marks.showAnswers(...this.shown, theme);
    this.redraw();
  }

  private showGround(): void {
    this.stepM = this.marks.showGround(this.extent, this.up, this.description.geographic, this.theme);
  }

  /** Measures the scene again by the Gaussians that are drawn, and looks from there unless a person moved on. */
  measureExtent(isOpening: boolean): void {
    this.extent = extentOf(this.cells.points(N_POINTS), this.up) ?? this.extent;
    this.ground = null;
    this.showGround();
    if (isOpening && !this.camera.wasMoved) this.showOpening(true);
    this.redraw();
  }

  showOpening(atOnce = false): void {
    const points = this.cells.nDrawn > 0 ? this.cells.points(N_POINTS) : pointsOfCells(this.description.cells);
    const halfTan = Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
    const { position, target } = openingPose(this.description, points, this.extent, this.up, this.camera.aspect, halfTan);
    const pose = [position, target].map((point) => point.add(this.world.position)) as [THREE.Vector3, THREE.Vector3];
    if (atOnce) this.camera.place(...pose);
    else this.camera.flyTo(...pose);
    this.redraw();
  }

  /** `opacities`: of their boxes. */
  showAnswers(name: string, answers: Answer[], opacities: number[], chosen: number | null): void {
    this.shown = [answers, opacities, chosen];
    this.marks.showAnswers(answers, opacities, chosen, this.theme);
    this.labelled.answers = answers.slice(0, MAX_LABELS).map((answer, i) => ({ text: i === chosen ? name : String(i + 1), at: this.over(answer), kind: i === chosen ? "chosen" : "answer" }))
      .filter((_, i) => chosen === null || i === chosen);
    this.writeLabels();
  }

  /** Names what a second question found. */
  showSecond(name: string, answers: Answer[]): void {
    this.labelled.second = answers.slice(0, MAX_LABELS).map((answer) => ({ text: name, at: this.over(answer), kind: "second" }));
    this.writeLabels();
  }

  private over(answer: Answer): Vector {
    const { centre, size } = boxOf(answer);
    return new THREE.Vector3(...centre).addScaledVector(this.up, size[2] / 2).toArray() as Vector;
  }

  /** Looks at an answer as its best photo does, from nearby; without that from where the camera is. */
  flyToAnswer(answer: Answer, photo: Photo | null): void {
    const { centre, size } = boxOf(answer);
    if (!photo) return this.flyTo(new THREE.Vector3(...centre), new THREE.Vector3(...size));
    const target = this.local(centre);
    const away = this.local(photo.position_m).sub(target);
    const distance = Math.min(away.length(), Math.max(this.camera.distanceOf((Math.hypot(...size) / 2) * ROOM_IN_PHOTO), 1));
    this.camera.flyTo(target.clone().addScaledVector(away.normalize(), distance), target);
    this.redraw();
  }

  flyToBox({ min, max }: { min: Vector; max: Vector }): void {
    const [low, high] = [new THREE.Vector3(...min), new THREE.Vector3(...max)];
    this.flyTo(low.clone().add(high).multiplyScalar(0.5), high.sub(low));
  }

  showChanges(changes: Change[]): void {
    this.marks.showChanges(changes);
    this.redraw();
  }

  private rayAt(xPx: number, yPx: number): THREE.Raycaster {
    const caster = new THREE.Raycaster();
    caster.setFromCamera(new THREE.Vector2((xPx / this.canvas.clientWidth) * 2 - 1, 1 - (yPx / this.canvas.clientHeight) * 2), this.camera.camera);
    return caster;
  }

  /** Index of the answer under a point of the canvas. */
  answerAt(xPx: number, yPx: number): number | null {
    const hit = this.rayAt(xPx, yPx).intersectObjects(this.marks.boxes.children.filter((child) => child.userData.index !== undefined))[0];
    return hit ? (hit.object.userData.index as number) : null;
  }

  /** What is seen at a point of the canvas: where it is, its height over the ground, its score. */
  surfaceAt(xPx: number, yPx: number): { point: Vector; heightM: number; score: number | null } | null {
    const { origin, direction } = this.rayAt(xPx, yPx).ray;
    const hit = this.cells.pick(origin.clone().sub(this.world.position).toArray() as Vector, direction.toArray() as Vector, 1 / this.camera.focalPx);
    if (!hit) return null;
    const point = new THREE.Vector3(...hit.point);
    this.ground ??= new Ground(this.cells.points(N_POINTS), this.extent, this.up);
    return { point: hit.point, heightM: this.up.dot(point) - this.ground.under(point), score: hit.score };
  }

  /** The photo that shows an answer largest with nothing in between, and where in it. */
  photoOf(answer: Answer, photos: Photo[]): { photo: string; box_px: [number, number, number, number] } | null {
    const { centre, size } = boxOf(answer);
    const found = photos.map((photo) => ({ photo, seen: seenBy(photo, answer) })).filter(({ seen }) => seen !== null)
      .sort((a, b) => b.seen!.share - a.seen!.share).slice(0, MOST_RAYS);
    for (const { photo, seen } of found) {
      const away = new THREE.Vector3(...centre).sub(new THREE.Vector3(...photo.position_m));
      const untilM = away.length() - Math.hypot(...size) / 2;
      const light = lightAlong(this.cells.all(), photo.position_m, away.normalize().toArray() as Vector, untilM, Math.ceil(this.cells.nDrawn / MOST_ON_A_RAY));
      if (light > LEAST_LIGHT) return { photo: photo.name, box_px: seen!.boxPx };
    }
    return null;
  }

  get coveredPx(): [number, number] {
    return this.covered();
  }

  showMeasured(points: Vector[], text: string): void {
    this.marks.showMeasured(points);
    const middle = points.length === 2 ? (points[0].map((v, i) => (v + points[1][i]) / 2) as Vector) : points[0];
    this.labelled.measured = middle ? [{ text, at: middle, kind: "measured" }] : [];
    this.writeLabels();
  }

  /** Takes a photo's camera, so that the picture laid over the canvas fits. */
  standAt(photo: Photo): void {
    const flipped = new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(1, 0, 0), Math.PI);
    const rotation = new THREE.Quaternion(...photo.rotation_xyzw).multiply(flipped);
    // What is free and narrower than the photo shows all of its width.
    const halfHeight = Math.max(photo.height_px, photo.width_px / this.camera.aspect) / 2;
    const fieldOfViewDeg = (Math.atan(halfHeight / photo.focal_px) * 360) / Math.PI;
    // It turns around what is in the middle, and the scale is of that.
    const along = new THREE.Vector3(0, 0, 1).applyQuaternion(new THREE.Quaternion(...photo.rotation_xyzw)).toArray() as Vector;
    const seen = this.cells.pick(photo.position_m, along, 1 / this.camera.focalPx);
    this.camera.standAt(this.local(photo.position_m), rotation, fieldOfViewDeg, seen?.distanceM ?? Math.max(this.radiusM * 0.2, 0.5));
    this.redraw();
  }

  /** Index of the photo whose camera is under a point of the canvas, if photos are shown. */
  photoAt(photos: Photo[], xPx: number, yPx: number): number | null {
    if (!this.marks.photos.visible) return null;
    return this.nearest(photos.map((photo) => photo.position_m), xPx, yPx);
  }

  /** Index of the place to stand under a point of the canvas. */
  placeUnder(goals: Goal[], xPx: number, yPx: number): number | null {
    return this.nearest(goals.map((goal) => goal.position_in_world), xPx, yPx);
  }

  /** Looks as a robot at a place does, at the thing. */
  lookFrom(goal: Goal, thing: Vector): void {
    this.camera.flyTo(this.local(goal.sensor_in_world), this.local(thing));
    this.redraw();
  }

  showRobot(description: Description, headingRad: number | null): void {
    // Every poll says where it is; a picture is drawn again only if that is news.
    // A ring around all of the scene is a line through every picture.
    const fetched = description.fetched && description.fetched.radius_m < this.radiusM ? description.fetched : undefined;
    const seen = JSON.stringify([description.position_m, fetched, headingRad]);
    if (seen === this.robotSeen) return;
    this.robotSeen = seen;
    this.marks.showRobot({ ...description, fetched }, headingRad, this.up);
    const { position_m } = description;
    this.labelled.robot = position_m ? [{ text: "Robot", at: new THREE.Vector3(...position_m).add(this.up).toArray() as Vector, kind: "robot" }] : [];
    this.writeLabels();
  }

  pose(): { position: Vector; target: Vector } {
    const world = (local: THREE.Vector3) => local.clone().sub(this.world.position).toArray() as Vector;
    return { position: world(this.camera.camera.position), target: world(this.camera.controls.target) };
  }

  placeAt(pose: { position: Vector; target: Vector }): void {
    this.camera.place(this.local(pose.position), this.local(pose.target));
    this.camera.wasMoved = true;
    this.redraw();
  }

  private local(point: Vector): THREE.Vector3 {
    return new THREE.Vector3(...point).add(this.world.position);
  }

  /** Pixel of a point of the world; null behind the camera. */
  private pixelOf(point: Vector): [number, number] | null {
    const { x, y, z } = this.local(point).project(this.camera.camera);
    return Math.abs(z) > 1 ? null : [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  /** Where the free part of the picture ends towards a point out of it, and in which direction that is; null within it. */
  private edgeTowards(point: Vector): { at: [number, number]; angleRad: number } | null {
    const { clientWidth, clientHeight } = this.canvas;
    const [left, bottom] = this.covered();
    const middle = [(left + clientWidth) / 2, (clientHeight - bottom) / 2];
    const half = [(clientWidth - left) / 2 - MARGIN_PX, (clientHeight - bottom) / 2 - MARGIN_PX];
    const pixel = this.pixelOf(point);
    const seen = this.local(point).applyMatrix4(this.camera.camera.matrixWorldInverse);
    const [x, y] = pixel ? [pixel[0] - middle[0], pixel[1] - middle[1]] : [seen.x, -seen.y];
    const share = Math.max(Math.abs(x) / half[0], Math.abs(y) / half[1]) || 1;
    if (pixel && share <= 1) return null;
    return { at: [middle[0] + x / share, middle[1] + y / share], angleRad: Math.atan2(y, x) };
  }

  /** Index of the point of the world that is drawn within a few pixels of a point of the canvas. */
  private nearest(points: Vector[], xPx: number, yPx: number): number | null {
    const distances = points.map((place) => {
      const at = this.pixelOf(place);
      return at ? Math.hypot(at[0] - xPx, at[1] - yPx) : Infinity;
    });
    const nearest = distances.indexOf(Math.min(...distances));
    return nearest >= 0 && distances[nearest] < NEAR_PX ? nearest : null;
  }

  private flyTo(centre: THREE.Vector3, size: THREE.Vector3): void {
    this.camera.flyTo(...this.camera.frame(centre.add(this.world.position), Math.max((size.length() / 2) * ROOM_AROUND, 0.3)));
    this.redraw();
  }

  private get radiusM(): number {
    return this.extent.box.getSize(new THREE.Vector3()).length() / 2;
  }

  resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    const size = this.renderer.getSize(new THREE.Vector2());
    if (size.x !== clientWidth || size.y !== clientHeight) this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.resize([clientWidth, Math.max(clientHeight, 1)], this.covered());
    this.redraw();
  }

  private step(nowMs: number): void {
    if (this.camera.step(nowMs)) this.redraw();
    this.noticeStill();
    this.frames.count(nowMs, this.camera.isMoving && this.isDirty);
    if (!this.isDirty) return;
    this.isDirty = false;
    if (this.marks.photos.visible) this.marks.hidePhotosNear(this.pose().position, this.description.metric ? NEAR_EYE_M : this.radiusM / 20);
    this.renderer.render(this.scene, this.camera.camera);
    this.placeLabels();
    const forward = this.camera.controls.target.clone().sub(this.camera.camera.position);
    this.hud.show(forward, forward.length() / this.camera.focalPx);
    for (const then of this.waiting.splice(0)) then();
  }

  private noticeStill(): void {
    if (this.camera.isMoving) return;
    const { position, target } = this.pose();
    const stands = [...position, ...target].join(",");
    if (stands === this.stood) return;
    this.stood = stands;
    this.onStill();
  }

  private get labelsNow(): Label[] {
    return [...this.labelled.measured, ...this.labelled.answers, ...this.labelled.second, ...this.labelled.robot];
  }

  private writeLabels(): void {
    this.labels.replaceChildren(...this.labelsNow.map(({ text, kind }) => {
      const label = document.createElement("span");
      label.textContent = text;
      label.className = kind;
      return label;
    }));
    this.redraw();
  }

  /** Puts labels over their points, or those of answers out of view where one has to turn; one that would cover an earlier one is left out. */
  private placeLabels(): void {
    const taken: [number, number, number][] = [];
    this.labelsNow.forEach(({ at, kind }, i) => {
      const label = this.labels.children[i] as HTMLElement;
      const isAnswer = ["answer", "chosen", "second"].includes(kind);
      const edge = isAnswer ? this.edgeTowards(at) : null;
      label.classList.toggle("beyond", edge !== null);
      if (edge) label.style.setProperty("--towards", `${edge.angleRad}rad`);
      const pixel = edge?.at ?? this.pixelOf(at);
      const isHidden = isAnswer && !this.marks.boxes.visible;
      // At an edge a long label is whole.
      const [lowPx, highPx] = edge ? [this.covered()[0] + EDGE_PX, this.canvas.clientWidth - label.offsetWidth - EDGE_PX] : [-Infinity, Infinity];
      const xPx = pixel ? Math.min(Math.max(pixel[0] - label.offsetWidth / 2, lowPx), highPx) : 0;
      const yPx = edge ? this.hud.beside([xPx, edge.at[1] - 10], label.offsetWidth) : pixel ? pixel[1] - 24 : 0;
      const isCovering = taken.some(([x, y, width]) => x < xPx + label.offsetWidth + 4 && xPx < x + width + 4 && Math.abs(y - yPx) < 24);
      label.style.visibility = !pixel || isCovering || isHidden ? "hidden" : "visible";
      label.style.transform = `translate(${xPx}px, ${yPx}px)`;
      if (pixel && !isCovering) taken.push([xPx, yPx, label.offsetWidth]);
    });
  }
}
