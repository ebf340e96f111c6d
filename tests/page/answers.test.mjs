// The page's texts on answers and on none, and what people copy of them, over the small known scene.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { closeBrowser, openBrowser } from "./browser.mjs";
import { answered, CAMERA, drawn, opened } from "./scene.mjs";
import { GOALS, THINGS } from "./service.mjs";

before(openBrowser);
after(closeBrowser);

const CLIPBOARD = { permissions: ["clipboard-read", "clipboard-write"] };
const PLATE = { name: "plate", min: [-2, 1, 0], max: [-1.3, 2.8, 0.004], n: [12, 12, 1] };

/** Presses one of the copy buttons, and returns what it copies. */
async function copied(page, name) {
  await page.locator(".copies").getByRole("button", { name, exact: true }).click();
  await page.locator(".copies").getByText("Copied").waitFor();
  const text = await page.evaluate(() => navigator.clipboard.readText());
  await page.locator(".copies").getByRole("button", { name, exact: true }).waitFor();
  return text;
}

test("ROS is sent to the best place to stand, with where to look; curl asks what was asked", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair -wall");
  await page.locator("#answers .card").click();
  await page.locator("#places button").first().waitFor();
  const [x, y, z] = GOALS[0].position_in_world.map((v) => v.toFixed(3));
  assert.equal(await copied(page, "ROS"), "ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped " +
    `'{header: {frame_id: world}, pose: {position: {x: ${x}, y: ${y}, z: ${z}}, orientation: {z: ${Math.sin(GOALS[0].yaw_rad / 2).toFixed(4)}, w: ${Math.cos(GOALS[0].yaw_rad / 2).toFixed(4)}}}}'`);
  assert.match(await copied(page, "curl"), /^curl 'http:\/\/127[^']*\/v1\/query\?text=chair&negative=wall'$/);
}, { behaviour: { goal: "reached" }, fragment: "q=chair -wall", options: CLIPBOARD }));

test("without a place to stand, ROS has the thing's point, which no robot drives to", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  await page.locator("#answers .card").click();
  await page.locator("#places").getByText("None: unreachable").waitFor();
  assert.equal(await copied(page, "ROS"), "ros2 topic pub --once /clicked_point geometry_msgs/msg/PointStamped '{header: {frame_id: world}, point: {x: 1.200, y: 0.800, z: 0.500}}'");
}, { behaviour: { goal: "unreachable" }, fragment: "q=chair", options: CLIPBOARD }));

test("sizes have the longer side first, the height last, and nothing is 0 thick", () => opened(async (page) => {
  await answered(page, "plate");
  assert.match(await page.locator("#answers .card").innerText(), /1\.8 × 0\.7 m × 1 cm/);
}, { behaviour: { things: [...THINGS, PLATE], known: [...THINGS, PLATE], program: "slag-encoder" }, fragment: "q=plate" }));

test("a card keeps its number beside its picture", () => opened(async (page) => {
  await answered(page, "chair");
  await page.locator("#answers .card img.crop").waitFor();
  assert.equal(await page.locator("#answers .card .number").innerText(), "1");
}, { behaviour: { evidence: { photo: "west/1.jpg", box_px: [400, 200, 500, 300], has_thumbnail: true } }, fragment: "q=chair" }));

test("what is not found is told with the best score, and the nearest are shown if they are wanted", () => opened(async (page, service) => {
  await answered(page, "wall");
  await page.getByText("Nothing here is like “wall” (best 0.16, found from 0.31).").waitFor();
  await page.getByRole("button", { name: "Show the nearest anyway" }).click();
  await page.locator("#answers .card").first().waitFor();
  assert.match(await page.locator("#answers .card").first().innerText(), /wall[^]*weak/);
  const long = "Donaudampfschifffahrt".repeat(10);
  await page.fill("#question", long);
  await answered(page, long);
  assert.ok(await page.locator("#panel").evaluate((panel) => panel.scrollWidth <= panel.clientWidth));
  service.behaviour.none = { kind: "clusters-too-small", detail: "3 Gaussians reach 0.30953595", best_score: 0.32 };
  await page.fill("#question", "armchair");
  await page.getByText("Not found. 3 Gaussians reach 0.310").waitFor();
}, { behaviour: { none: { kind: "below-threshold", detail: "no object reaches 0.30953595", best_score: 0.1602 }, threshold: 0.30953595 }, fragment: "q=wall" }));

test("whereabouts follow the camera once it stops", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  const card = page.locator("#answers .card");
  await card.getByText("7.7 m from this view, ahead").waitFor();
  await page.locator("#canvas").focus();
  await page.keyboard.press("r");
  await card.getByText("7.7 m from this view").waitFor({ state: "detached" });
  assert.match(await card.innerText(), /m from this view/);
}, { behaviour: { position: null, program: "slag-encoder" }, fragment: `q=chair&camera=${CAMERA}` }));

test("where and how the asker stands is sent if the question needs it, and only then", () => opened(async (page, service) => {
  await answered(page, "chair near me");
  await page.getByText("1 found · seen from this view").waitFor();
  const asked = () => service.behaviour.requests.filter((path) => path.startsWith("/v1/query")).map((path) => new URLSearchParams(path.split("?")[1]));
  const [first, second] = asked();
  assert.deepEqual([first.has("near"), first.has("heading_rad"), second.get("near")], [false, false, "0.5,-6,4"]);
  assert.ok(Math.abs(Number(second.get("heading_rad")) - Math.atan2(6, -0.5)) < 1e-3, second.get("heading_rad"));
  await page.fill("#question", "chair");
  await answered(page, "chair");
  assert.deepEqual([asked().length, asked()[2].has("near")], [3, false]);
}, { behaviour: { position: null }, fragment: `q=chair near me&camera=${CAMERA}`, expected: /400/ }));

test("a store's page says that it does not understand relations", () => opened(async (page) => {
  await answered(page, "wall behind the chair");
  await page.getByText("Robots answer relations; this page looks for the words as they are.").waitFor();
  await page.fill("#question", "chair");
  await answered(page, "chair");
  assert.equal(await page.getByText("Robots answer relations").count(), 0);
}, { behaviour: { program: "slag-encoder" }, fragment: "q=wall behind the chair" }));
