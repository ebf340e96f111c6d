// Places to stand near the chosen thing: asked of the robot, drawn as poses on the ground, listed with the answer.

import { showPlaces } from "./cards";
import type { Drawing } from "./drawing/drawing";
import { ROBOT_RADIUS_M } from "./drawing/marks";
import { type Answer, type Description, type Goal, type Goals, fetchGoals, isObject } from "./network";

const NO_OBJECT = "Places are known for objects; this answer is a group of Gaussians.";

export class PlacesToStand {
  private found: Goals | null = null;
  private chosen: number | null = null;
  private asking = new AbortController();

  constructor(private readonly drawing: Drawing) {}

  /** Asks for places near an answer; without an answer, clears them. */
  async ask(answer: Answer | null, description: Description): Promise<void> {
    this.asking.abort();
    this.asking = new AbortController();
    const { signal } = this.asking;
    this.found = this.chosen = null;
    this.draw();
    // Only a robot knows where it can stand.
    if (!answer || description.program !== "slag-edge") return;
    if (!answer.id || !isObject(answer)) return showPlaces([], NO_OBJECT, null, () => {});
    try {
      const found = await fetchGoals(answer.id, ROBOT_RADIUS_M, signal);
      if (signal.aborted) return;
      this.found = found;
      this.draw();
      this.list();
    } catch (error) {
      // The scene has no occupancy, or the service is busy or gone: the service's own words say which.
      if (!signal.aborted) showPlaces([], error instanceof Error ? error.message : String(error), null, () => {});
    }
  }

  /** The place that was chosen, else the best one. */
  get best(): Goal | null {
    return this.found?.goals[this.chosen ?? 0] ?? null;
  }

  /** Chooses the place under a point of the canvas, if there is one. */
  chooseAt(xPx: number, yPx: number): boolean {
    const index = this.found && this.drawing.placeUnder(this.found.goals, xPx, yPx);
    if (index === null) return false;
    this.choose(index);
    return true;
  }

  private choose(index: number): void {
    if (!this.found) return;
    this.chosen = index;
    this.draw();
    this.list();
    const goal = this.found.goals[index];
    if (this.found.thing) this.drawing.lookFrom(goal, this.found.thing);
  }

  private draw(): void {
    this.drawing.places.show(this.found?.goals ?? [], this.found?.thing ?? null, ROBOT_RADIUS_M, this.chosen);
    this.drawing.redraw();
  }

  private list(): void {
    const none = this.found?.none;
    showPlaces(this.found?.goals ?? [], none ? `None: ${none.kind.replaceAll("-", " ")}. ${none.detail}` : null, this.chosen, (index) => this.choose(index));
  }
}
