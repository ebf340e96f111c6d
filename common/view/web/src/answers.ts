// What is said of an answer: how sure it is, how large, how far and in which direction, and what people copy of it.

import { boxOf } from "./drawing/marks";
import type { Answer, Vector } from "./network";

export type Strength = "strong" | "likely" | "weak";

/** Shares of the threshold by which a score is above it. */
const [LIKELY_FROM, STRONG_FROM] = [0.15, 0.3];
/** Of their boxes. */
export const OPACITY: Record<Strength, number> = { strong: 1, likely: 0.75, weak: 0.4 };
const WINDS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];
const SIDES = ["ahead", "ahead, right", "right", "behind, right", "behind", "behind, left", "left", "ahead, left"];

/** How far above the threshold an answer is. Clusters have no mask of their own and are never strong. */
export function strengthOf({ score, id }: Answer, threshold: number | null): Strength {
  const above = threshold && threshold > 0 ? score / threshold - 1 : 0;
  if (above >= STRONG_FROM) return id ? "strong" : "likely";
  return above >= LIKELY_FROM ? "likely" : "weak";
}

/** From where distances and directions are said. */
export interface Viewpoint {
  at: Vector;
  /** Whose it is. */
  from: "the robot" | "here";
  /** Where it looks, from x towards y; null if that is not known. */
  headingRad: number | null;
  isGeographic: boolean;
}

export function lengthText(length: number, isMetric: boolean): string {
  if (!isMetric) return length.toPrecision(2);
  return length >= 1000 ? `${(length / 1000).toFixed(1)} km` : length >= 20 ? `${length.toFixed(0)} m` : length >= 1 ? `${length.toFixed(1)} m` : `${(length * 100).toFixed(0)} cm`;
}

export function whereabouts(to: Vector, { at, from, headingRad, isGeographic }: Viewpoint, isMetric: boolean): string {
  const [x, y] = [to[0] - at[0], to[1] - at[1]];
  const eighth = (clockwiseRad: number) => ((Math.round(clockwiseRad / (Math.PI / 4)) % 8) + 8) % 8;
  const angle = Math.atan2(y, x);
  const direction = isGeographic ? WINDS[eighth(Math.PI / 2 - angle)] : headingRad === null ? "" : SIDES[eighth(headingRad - angle)];
  const distance = lengthText(Math.hypot(...to.map((v, i) => v - at[i])), isMetric);
  if (isGeographic) return `${distance} ${direction} of ${from}`;
  return `${distance} from ${from}${direction ? `, ${direction}` : ""}`;
}

/** Breadth, depth and height, in one unit. */
export function sizeText(answer: Answer, isMetric: boolean): string {
  const { size } = boxOf(answer);
  const [factor, unit] = !isMetric ? [1, ""] : Math.max(...size) < 1 ? [100, " cm"] : [1, " m"];
  const digits = factor === 100 || Math.max(...size) >= 20 ? 0 : 1;
  return `${size.map((length) => (length * factor).toFixed(digits)).join(" × ")}${unit}`;
}

export const metres = (v: number[]) => `${v.map((x) => x.toFixed(2)).join(", ")} m`;

/** What the copy buttons put on the clipboard. */
export function copies(answer: Answer, question: string): Record<string, string> {
  const [x, y, z] = answer.position_in_world.map((v) => v.toFixed(3));
  const pose = `{header: {frame_id: world}, pose: {position: {x: ${x}, y: ${y}, z: ${z}}, orientation: {w: 1.0}}}`;
  return {
    World: `${x}, ${y}, ${z}`,
    ...(answer.geographic ? { "Lat, lon": `${answer.geographic.latitude_deg.toFixed(7)}, ${answer.geographic.longitude_deg.toFixed(7)}` } : {}),
    curl: `curl '${location.origin}/v1/query?text=${encodeURIComponent(question)}'`,
    ROS: `ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '${pose}'`,
  };
}
