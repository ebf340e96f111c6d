// The robot in words: how old its scene is, what it fetched, and whether the service is reached.

import { lengthText } from "./answers";
import { type Description, fetchMap, type Vector } from "./network";
import { panel } from "./panel";

/** A robot that moved less has the heading that it had. */
const LEAST_WAY_M = 0.05;

function ageText(seconds: number): string {
  const [value, unit] = seconds < 5400 ? [seconds / 60, "min"] : seconds < 172_800 ? [seconds / 3600, "h"] : [seconds / 86_400, "days"];
  return `${Math.max(Math.round(value), 1)} ${unit}`;
}

export class Robot {
  /** The way that it went last, from x towards y. */
  headingRad: number | null = null;
  private before: Vector | null = null;

  /** Takes its place; its heading is that of its last move. */
  see({ position_m }: Description): void {
    if (position_m && this.before) {
      const [x, y] = [position_m[0] - this.before[0], position_m[1] - this.before[1]];
      if (Math.hypot(x, y) < LEAST_WAY_M) return;
      this.headingRad = Math.atan2(y, x);
    }
    this.before = position_m ?? null;
  }

  /** Writes its line and its badge. */
  async show(description: Description, isOffline: boolean): Promise<void> {
    panel.badge.hidden = !isOffline;
    panel.badge.textContent = "offline";
    if (isOffline || description.program !== "slag-edge") return;
    const map = await fetchMap().catch(() => null);
    const { fetched, position_m } = description;
    const isOld = map?.is_expired ?? false;
    panel.robot.hidden = false;
    panel.robot.textContent = [
      position_m ? "Robot, the green mark" : "Robot, its place unknown",
      map ? `scene ${ageText(map.age_secs)} old` : "",
      fetched ? `${lengthText(fetched.radius_m, description.metric)} around it on board` : "",
    ].filter(Boolean).join(" · ");
    if (isOld) Object.assign(panel.badge, { hidden: false, textContent: "out of date" });
  }
}
