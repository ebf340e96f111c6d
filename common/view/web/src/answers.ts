// What is said of an answer: how sure it is, how large, how far and in which direction, and what people copy of it.

import { boxOf } from "./drawing/marks";
import type { Answer, Goal, Vector } from "./network";

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
  from: "the robot" | "this view";
  /** Where it looks, from x towards y; null if that is not known. */
  headingRad: number | null;
  isGeographic: boolean;
}

export function lengthText(length: number, isMetric: boolean): string {
  if (!isMetric) return length.toPrecision(2);
  return length >= 1000 ? `${(length / 1000).toFixed(1)} km` : length >= 20 ? `${length.toFixed(0)} m` : length >= 0.995 ? `${length.toFixed(1)} m` : `${(length * 100).toFixed(0)} cm`;
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

/** The longer horizontal side, the other one and the height; below 10 cm in centimetres, and 1 at least. */
export function sizeText(answer: Answer, isMetric: boolean): string {
  const { size } = boxOf(answer);
  const sides = [Math.max(size[0], size[1]), Math.min(size[0], size[1]), size[2]];
  if (!isMetric) return sides.map((length) => length.toPrecision(2)).join(" × ");
  const isSmall = Math.max(...sides) < 1;
  const texts = sides.map((length) => (isSmall || length < 0.1 ? [String(Math.max(Math.round(length * 100), 1)), "cm"] : [length.toFixed(length >= 20 ? 0 : 1), "m"]));
  // A unit stands where the next side has another.
  return texts.map(([text, unit], i) => (texts[i + 1]?.[1] === unit ? text : `${text} ${unit}`)).join(" × ");
}

export const metres = (v: number[]) => `${v.map((x) => x.toFixed(2)).join(", ")} m`;

/**
 * What the copy buttons put on the clipboard. `query`: the question's parameters. Robots drive to goals: one is
 * sent to `place`, where it can stand, and without that no goal but a point.
 */
export function copies(answer: Answer, query: string, place: Goal | null): Record<string, string> {
  const [x, y, z] = answer.position_in_world.map((v) => v.toFixed(3));
  return {
    World: `${x}, ${y}, ${z}`,
    ...(answer.geographic ? { "Lat, lon": `${answer.geographic.latitude_deg.toFixed(7)}, ${answer.geographic.longitude_deg.toFixed(7)}` } : {}),
    ...(query ? { curl: `curl '${location.origin}/v1/query?${query}'` } : {}),
    ROS: place ? `ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '${poseOf(place)}'`
      : `ros2 topic pub --once /clicked_point geometry_msgs/msg/PointStamped '{header: {frame_id: world}, point: {x: ${x}, y: ${y}, z: ${z}}}'`,
  };
}

function poseOf({ position_in_world, yaw_rad }: Goal): string {
  const [x, y, z] = position_in_world.map((v) => v.toFixed(3));
  const orientation = `{z: ${Math.sin(yaw_rad / 2).toFixed(4)}, w: ${Math.cos(yaw_rad / 2).toFixed(4)}}`;
  return `{header: {frame_id: world}, pose: {position: {x: ${x}, y: ${y}, z: ${z}}, orientation: ${orientation}}}`;
}
