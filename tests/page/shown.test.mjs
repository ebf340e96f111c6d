// What the page shows besides answers, over the small known scene: changes, cameras of photos.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { closeBrowser, layer, NIGHTLY, openBrowser, pixels } from "./browser.mjs";
import { answered, CAMERA, cameraOf, drawn, opened, PANEL_PX, project } from "./scene.mjs";
import { THINGS } from "./service.mjs";

before(openBrowser);
after(closeBrowser);

/** Source of a function that tells whether a pixel has a colour: it runs in the browser. */
const isColour = ([r, g, b]) => `(r, g, b) => Math.hypot(r - ${r}, g - ${g}, b - ${b}) < 24`;
const COLOURS = { appeared: [0x4f, 0xd1, 0x7a], went: [0xe0, 0x5a, 0x4e], moved: [0xf2, 0xb1, 0x34] };

const thing = (id, [x, y, z], half = 0.3) => ({
  id, position_in_world: [x, y, z], box_in_world: { min: [x - half, y - half, z - half], max: [x + half, y + half, z + half] },
});
const CHANGES = {
  old_generation: 1, new_generation: 2, n_same: 3, n_stayed: 1,
  appeared: [thing("a1", [1.2, 0.8, 0.5])], went: [thing("b1", [-1.5, -1, 0.5])], moved: [{ from: thing("c0", [0, 2, 0.4]), to: thing("c1", [1, 2.5, 0.4]) }],
};

test("what appeared, went and moved is listed and boxed in the colour of its kind", () => opened(async (page) => {
  await drawn(page);
  await layer(page, "grid", false);
  await layer(page, "changes", true);
  await page.locator("#changes").getByText("1 appeared, 1 went, 1 moved, 4 stayed").waitFor();
  assert.deepEqual(await page.locator("#changes button").allInnerTexts(), [
    "Appeared: 1.20, 0.80, 0.50 m", "Went: -1.50, -1.00, 0.50 m", "Moved by 1.12 m: 1.00, 2.50, 0.40 m",
  ]);
  const boxes = { appeared: CHANGES.appeared[0], went: CHANGES.went[0], moved: CHANGES.moved[0].to };
  for (const [kind, colour] of Object.entries(COLOURS)) {
    const found = await pixels(page, PANEL_PX, isColour(colour), kind);
    const { min, max } = boxes[kind].box_in_world;
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => project(min.map((low, k) => ((i >> k) & 1 ? max[k] : low))));
    for (const [u, v] of corners.filter(([x]) => x > PANEL_PX + 4)) {
      assert.ok(found.some(([x, y]) => Math.hypot(x + 0.5 - u, y + 0.5 - v) < 3), `${kind}: no line ends at ${u}, ${v}`);
    }
  }
  await layer(page, "changes", false);
  assert.ok(await page.locator("#changes").isHidden());
}, { isLookedAt: true, behaviour: { program: "slag-encoder", generation: 2, changes: CHANGES }, fragment: `camera=${CAMERA}` }));

/** A thing as a robot describes it. */
const onRobot = ({ id, position_in_world, box_in_world: { min, max } }) => ({ id, position_in_world, box_min_in_world: min, box_max_in_world: max });
const OF_ROBOT = {
  from: { generation: 4 }, to: { generation: 7 }, n_same: 2, n_stayed: 0, none: null,
  appeared: CHANGES.appeared.map(onRobot), went: [], moved: CHANGES.moved.map(({ from, to }) => ({ from: onRobot(from), to: onRobot(to) })),
};

test("a robot's changes are listed, and its reason where it has none", () => opened(async (page, service) => {
  await drawn(page);
  await layer(page, "changes", true);
  await page.locator("#changes").getByText("Generation 4 to 7").waitFor();
  assert.deepEqual(await page.locator("#changes button").allInnerTexts(), ["Appeared: 1.20, 0.80, 0.50 m", "Moved by 1.12 m: 1.00, 2.50, 0.40 m"]);
  service.behaviour.changes = { ...OF_ROBOT, from: null, none: { kind: "no-earlier-generation", detail: "the robot has had one generation" } };
  await layer(page, "changes", false);
  await layer(page, "changes", true);
  await page.locator("#changes").getByText("the robot has had one generation").waitFor();
}, { behaviour: { generation: 7, changes: OF_ROBOT } }));

test("without a generation before, the service's words say so", () => opened(async (page) => {
  await drawn(page);
  await layer(page, "changes", true);
  await page.locator("#changes").getByText("one generation alone").waitFor();
}, { behaviour: { program: "slag-encoder", generation: 2 }, expected: /409/ }));

// The test's camera would have it under the panel: this one looks at the scene's middle from the other side.
const PHOTO = { name: "roof/12.jpg", position_m: [1.5, 1.5, 1.2], rotation_xyzw: [0.7071068, 0, 0, 0.7071068], width_px: 640, height_px: 480, focal_px: 500, has_picture: false };

test("a camera without its picture can be clicked and stood in", () => opened(async (page) => {
  await drawn(page);
  await layer(page, "grid", false);
  await layer(page, "photos", true);
  // Edges of a frustum, a fiftieth of the scene's radius along: its forward z is -y of the world, its down y is z.
  const green = await pixels(page, PANEL_PX, isColour([0x6f, 0xbf, 0x8b]));
  const length = Math.hypot(8, 8, 1.1) / 2 / 60;
  for (const [x, y] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
    const offset = [(x * PHOTO.width_px) / 2 / PHOTO.focal_px, -1, (y * PHOTO.height_px) / 2 / PHOTO.focal_px];
    const [u, v] = project(PHOTO.position_m.map((value, i) => value + length * offset[i]));
    assert.ok(green.some(([px, py]) => Math.hypot(px + 0.5 - u, py + 0.5 - v) < 2), `no corner at ${u}, ${v}`);
  }
  const [u, v] = project(PHOTO.position_m);
  await page.mouse.click(u, v);
  await page.locator("#details").getByText("roof/12.jpg").waitFor();
  assert.equal(await page.locator("#details svg").count(), 0);
  await page.click("#copy-link");
  const camera = new URLSearchParams(new URL(page.url()).hash.slice(1)).get("camera").split(",").map(Number);
  // Its rotation turns z, forward, to -y.
  assert.deepEqual(camera.slice(0, 3), PHOTO.position_m);
  assert.ok(Math.abs(camera[3] - 1.5) < 0.01 && camera[4] < 1.5 - 0.4 && Math.abs(camera[5] - 1.2) < 0.01, String(camera));
  // One stands in its lines, which are left out.
  assert.equal((await pixels(page, PANEL_PX, isColour([0x6f, 0xbf, 0x8b]))).length, 0);
}, { isLookedAt: true, behaviour: { photos: [PHOTO] }, fragment: `camera=${CAMERA}` }));

test("missing and earlier cells are told and outlined, and the robot is where it says", () => opened(async (page, service) => {
  await page.getByText("1 of 3 cells missing · 1 of an earlier generation").waitFor({ timeout: 30000 });
  await layer(page, "grid", false);
  await layer(page, "cells", true);
  // A corner of a box, or the foot of the robot's post, is drawn in its colour.
  const isDrawnAt = async (colour, point) => {
    const [u, v] = project(point);
    const found = await pixels(page, PANEL_PX, isColour(colour));
    return found.some(([x, y]) => Math.hypot(x + 0.5 - u, y + 0.5 - v) < 3);
  };
  const [, chair, ball] = service.behaviour.things;
  assert.ok(await isDrawnAt(COLOURS.went, [ball.max[0], ball.max[1], ball.max[2]]));
  assert.ok(await isDrawnAt([0xd9, 0x9a, 0x2b], chair.max));
  const ROBOT = [0x4f, 0xd1, 0xa5];
  assert.ok(await isDrawnAt(ROBOT, [1, 2, 1]));
  service.behaviour.position = [2, 1, 0];
  service.behaviour.tell("following", {});
  await page.waitForFunction(() => performance.getEntriesByType("resource").filter(({ name }) => name.endsWith("/v1/view")).length > 1);
  assert.ok(await isDrawnAt(ROBOT, [2, 1, 1]) && !(await isDrawnAt(ROBOT, [1, 2, 1])));
}, { isLookedAt: true, behaviour: { missing: [2], stale: [1], position: [1, 2, 0] }, fragment: `camera=${CAMERA}` }));

for (const [fetchedM, isSeen] of [[4, true], [7, false]]) {
  test(`what was fetched has a ring, unless that is all of the scene: ${fetchedM} m`, () => opened(async (page) => {
    await drawn(page);
    assert.equal((await pixels(page, PANEL_PX, isColour([0x4f, 0xd1, 0xa5]))).length > 20, isSeen);
  }, { isLookedAt: true, behaviour: { position: null, fetchedM }, fragment: `camera=${CAMERA}` }));
}

test("a geo-referenced scene has east, north and up, latitude and longitude, and an arrow to the north", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  const red = await pixels(page, PANEL_PX, isColour([0xe0, 0x5a, 0x4e]));
  // The arrow leaves the middle of the ground along y, visible beyond the floor.
  const [u, v] = project([0, 5.5, -0.1]);
  assert.ok(red.some(([x, y]) => Math.hypot(x + 0.5 - u, y + 0.5 - v) < 3));
  await page.locator("#answers .card").click();
  assert.match(await page.locator("#details").innerText(), /East, north, up\s+1\.20, 0\.80, 0\.50 m[^]*48\.1000000, 11\.5000000/);
}, { isLookedAt: true, behaviour: { geographic: true, goal: "unreachable" }, fragment: `q=chair&camera=${CAMERA}` }));

test("fingers choose and turn", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  const before = await cameraOf(page);
  const touch = await page.context().newCDPSession(page);
  const send = (type, points) => touch.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y]) => ({ x, y })) });
  await send("touchStart", [[700, 520]]);
  for (let i = 1; i <= 5; i++) await send("touchMove", [[700 + 20 * i, 520]]);
  await send("touchEnd", []);
  const [from, to] = await cameraOf(page);
  assert.ok(Math.hypot(...from.map((value, i) => value - before[0][i])) > 0.5 && to.every((value, i) => Math.abs(value - before[1][i]) < 0.01), `${from}, ${to}`);
  const [u, v] = project([1.2, 0.8, 0.5], from, to);
  await page.touchscreen.tap(u, v);
  await page.locator("#details").getByText("1.20, 0.80, 0.50 m").waitFor();
}, { behaviour: { goal: "unreachable" }, options: { hasTouch: true }, fragment: `q=chair&camera=${CAMERA}` }));

/** A floor of so many Gaussians that the first picture has a part of them. */
const LARGE = THINGS.map((thing) => (thing.name === "floor" ? { ...thing, n: [700, 700, 1] } : thing));

test("of a large scene a part is drawn at first, then all, and fewer again where frames take long", NIGHTLY, () => opened(async (page, service) => {
  const steps = () => service.behaviour.requests.filter((path) => path.startsWith("/v1/view/cells/")).map((path) => [Number(path.match(/cells\/(\d+)/)[1]), Number(path.match(/step=(\d+)/)[1])]);
  await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, { timeout: 120000 });
  const [first, second] = [steps().slice(0, 3), steps().slice(3)];
  for (const asked of [first, second]) assert.deepEqual(asked.map(([cell]) => cell).sort(), [0, 1, 2]);
  assert.deepEqual([first, second].map((asked) => [...new Set(asked.map(([, step]) => step))]), [[4], [1]]);
  const amount = page.locator("#amount");
  assert.match(await amount.textContent(), /^493,264 of 493,264 Gaussians/);
  // A software GPU draws this many at less than 25 frames a second.
  await page.locator("#canvas").focus();
  await page.keyboard.down("ArrowLeft");
  await page.waitForFunction(() => document.getElementById("amount").textContent.startsWith("246,632 of 493,264"), null, { timeout: 120000 });
  await page.keyboard.up("ArrowLeft");
  // Not even the nearest cell, the floor, fits into the budget in full.
  assert.deepEqual(steps().slice(6).sort(), [[0, 2], [1, 2], [2, 2]]);
}, { behaviour: { things: LARGE }, isLookedAt: true, options: { viewport: { width: 720, height: 320 } }, fragment: `camera=${CAMERA}` }));
