// The built page in Chromium over a small known scene, whose service can refuse, vanish and publish at will: lit points
// are compared with the true boxes. `real.test.mjs` asks the real programs.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { axe, closeBrowser, keepPicture, layer, openBrowser } from "./browser.mjs";
import { answered, CAMERA, cameraOf, dot, drawn, HEIGHT, isInside, litPixels, minus, opened, PANEL_PX, POSITION, project, TARGET, WIDTH } from "./scene.mjs";
import { THINGS } from "./service.mjs";

before(openBrowser);
after(closeBrowser);

for (const name of ["chair", "ball"]) {
  test(`pixels that "${name}" lights are those of the truth`, () => opened(async (page) => {
    await drawn(page);
    await answered(page, name);
    await keepPicture(page, `${name}-answered`);
    const lit = await litPixels(page, `${name}-lit`);
    const thing = THINGS.find((entry) => entry.name === name);
    let truePixels = 0;
    for (let x = PANEL_PX; x < WIDTH; x++) for (let y = 0; y < HEIGHT; y++) truePixels += isInside(thing, [x, y], 0) ? 1 : 0;
    const precision = lit.filter((pixel) => isInside(thing, pixel, 8)).length / lit.length;
    const recall = lit.filter((pixel) => isInside(thing, pixel, 0)).length / truePixels;
    console.log(`${name}: ${lit.length} lit, precision ${precision.toFixed(3)}, recall ${recall.toFixed(3)}`);
    assert.ok(truePixels > 2000 && precision > 0.98 && recall > 0.85);
  }, { isLookedAt: true, fragment: `q=${name}&camera=${CAMERA}` }));
}

test("typing asks after a pause, the slider unlights, a click shows the thing, and the address keeps it", () => opened(async (page) => {
  await drawn(page);
  assert.ok(Number(await page.evaluate(() => document.documentElement.dataset.firstPictureMs)) < 10000);
  await page.locator("#question").pressSequentially("chair");
  await answered(page, "chair");
  assert.match(page.url(), /q=chair/);
  const before = (await litPixels(page)).length;
  await page.locator("#threshold").fill("250");
  const after = (await litPixels(page)).length;
  assert.ok(before > 2000 && after === 0, `${before} lit, then ${after}`);
  assert.match(page.url(), /threshold=0\.98/);
  const [x, y] = project([1.2, 0.8, 0.5]);
  await layer(page, "boxes", true);
  await page.mouse.click(x, y);
  await page.locator("#details").waitFor();
  assert.match(await page.locator("#details").innerText(), /1\.20, 0\.80, 0\.50 m/);
  await page.fill("#question", "unicorn");
  await page.getByText("nothing found").waitFor();
}, { isLookedAt: true, behaviour: { goal: "unreachable" }, fragment: `camera=${CAMERA}` }));

/** As like a chair as the chair is, but no answer. */
const STOOL = { name: "chair", min: [-1.5, 1.5, 0], max: [-0.5, 2.5, 1], n: [12, 12, 12] };

test("only objects that answer are lit until the slider moves, and a slow question says that it is under way", () => opened(async (page) => {
  await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined);
  await answered(page, "chair");
  const isOf = async (thing) => (await litPixels(page)).filter((pixel) => isInside(thing, pixel, 0)).length;
  assert.equal(await isOf(STOOL), 0);
  await page.locator("#threshold").fill("200");
  assert.ok(await isOf(STOOL) > 500);
  await page.route("**/v1/query*", async (route) => {
    await new Promise((resolve) => setTimeout(resolve, 1500));
    await route.continue();
  });
  await page.fill("#question", "ball");
  await page.locator("#message").getByText("Looking…").waitFor();
  assert.equal(await page.locator("#answers").getAttribute("aria-busy"), "true");
  await answered(page, "ball");
  assert.deepEqual([await page.locator("#message").innerText(), await page.locator("#answers").getAttribute("aria-busy")], ["1 found", "false"]);
}, { isLookedAt: true, behaviour: { things: [...THINGS, STOOL] }, fragment: `q=chair&camera=${CAMERA}` }));

test("negatives go to the service, and there may be more answers than are shown", () => opened(async (page, service) => {
  await drawn(page);
  await page.fill("#question", "chair -wall -floor");
  await answered(page, "chair -wall -floor");
  for (const path of ["/v1/view/scores?text=chair&negative=wall&negative=floor", "/v1/query?text=chair&negative=wall&negative=floor&limit=21"]) {
    assert.ok(service.behaviour.requests.includes(path), path);
  }
  assert.deepEqual([await page.locator("#message").innerText(), await page.locator("#answers .card").count()], ["20+ found", 20]);
}, { behaviour: { nAnswers: 25 } }));

test("a phrase lights its thing and tells what it is related to", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "ball on the floor");
  await page.locator("#answers .card").click();
  await page.locator("#details").getByText("holds to 0.93").waitFor();
  assert.match(await page.locator("#answers li").innerText(), /ball[^]*48\.1000000, 11\.5000000[^]*To: floor/);
  await page.evaluate((fragment) => { location.hash = fragment; location.reload(); }, `q=ball on the floor&camera=${CAMERA}`);
  await drawn(page);
  await answered(page, "ball on the floor");
  const lit = await litPixels(page);
  const ball = THINGS.find(({ name }) => name === "ball");
  assert.ok(lit.length > 5000 && lit.every((pixel) => isInside(ball, pixel, 8)));
}, { isLookedAt: true, behaviour: { goal: "unreachable" }, fragment: `q=ball on the floor&camera=${CAMERA}` }));

test("a missing cell is told, and drawn once it is there", () => opened(async (page, service) => {
  await page.getByText("1 of 3 cells missing").waitFor();
  await layer(page, "cells", true);
  await keepPicture(page, "cells");
  assert.ok(!service.behaviour.requests.some((path) => path.startsWith("/v1/view/cells/2")));
  service.behaviour.missing = [];
  await drawn(page);
  await page.getByText("Other cells are on board").waitFor();
}, { behaviour: { missing: [2] } }));

test("keys reach the question and move the camera", () => opened(async (page) => {
  await drawn(page);
  await page.keyboard.press("/");
  await page.keyboard.type("ball");
  await answered(page, "ball");
  await page.locator("#canvas").focus();
  await page.keyboard.down("KeyW");
  // The page writes its camera into the address now and then.
  await page.waitForFunction(([x, y, z]) => {
    const camera = new URLSearchParams(location.hash.slice(1)).get("camera")?.split(",").map(Number) ?? [x, y, z];
    return Math.hypot(camera[0] - x, camera[1] - y, camera[2] - z) > 0.1;
  }, POSITION, { timeout: 30000 });
  await page.keyboard.up("KeyW");
  const moved = minus((await cameraOf(page))[0], POSITION);
  const forward = minus(TARGET, POSITION);
  assert.ok(dot(moved, forward) > 0.99 * Math.hypot(...moved) * Math.hypot(...forward), `moved by ${moved}`);
  // Without a pointer: from the question to the first answer and its details.
  await page.locator("#question").focus();
  for (let i = 0; i < 12 && !(await page.evaluate(() => document.activeElement?.closest("#answers"))); i++) await page.keyboard.press("Tab");
  assert.notEqual(await page.evaluate(() => getComputedStyle(document.activeElement).outlineStyle), "none");
  await page.keyboard.press("Enter");
  await page.locator("#details").getByText("Score").waitFor();
  assert.equal(await page.evaluate(() => document.activeElement.getAttribute("aria-expanded")), "true");
  // The card has the focus, and keys still fly.
  const [before] = await cameraOf(page);
  await page.locator("#answers .card").focus();
  await page.keyboard.press("KeyE", { delay: 500 });
  assert.ok((await cameraOf(page))[0][2] > before[2]);
}, { behaviour: { goal: "unreachable" }, fragment: `camera=${CAMERA}` }));

test("a service without a scene says so, and the page opens when it has one", () => opened(async (page, service) => {
  await page.getByText("no scene to show").waitFor();
  service.behaviour.hasScene = true;
  await drawn(page);
}, { behaviour: { hasScene: false }, expected: /404/ }));

test("the token is asked for once", () => opened(async (page, service) => {
  await page.locator("#token").fill("secret");
  await page.keyboard.press("Enter");
  await drawn(page);
  assert.equal(service.behaviour.requests.filter((path) => path === "/v1/view").length, 2);
}, { behaviour: { token: "secret" }, expected: /401/ }));

test("a lost service and another generation are told", () => opened(async (page, service) => {
  await drawn(page);
  service.behaviour.isGone = true;
  await page.getByText("cannot be reached").waitFor({ timeout: 15000 });
  await page.fill("#question", "chair");
  await page.waitForTimeout(500);
  service.behaviour.isGone = false;
  await answered(page, "chair");
  service.behaviour.generation = 2;
  await page.getByText("generation 2 now").waitFor({ timeout: 15000 });
  await drawn(page);
}, { expected: /ERR_EMPTY_RESPONSE|ERR_CONNECTION|ERR_SOCKET/ }));

for (const [name, options] of [["dark", {}], ["light", { colorScheme: "light" }], ["narrow", { viewport: { width: 360, height: 640 } }]]) {
  test(`axe finds nothing: ${name}`, () => opened(async (page) => {
    await drawn(page);
    await answered(page, "chair");
    await keepPicture(page, name);
    assert.ok(await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth));
    const found = await page.evaluate(`(() => { ${axe}; return axe.run(); })()`);
    assert.deepEqual(found.violations.map(({ id, nodes }) => `${id}: ${nodes[0].html}`), []);
  }, { fragment: "q=chair", options }));
}

test("without WebGL 2 a plain message says so", async () => {
  await opened(async (page) => {
    await page.addInitScript(() => {
      const original = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        return kind === "webgl2" ? null : original.call(this, kind, ...rest);
      };
    });
    await page.reload();
    await page.getByText("no WebGL 2").waitFor();
  });
});
