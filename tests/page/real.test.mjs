// The page of the real programs in Chromium: lit points are compared with the mask of a photo that was not encoded.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { closeBrowser, keepPicture, layer, litPixels, NIGHTLY, openBrowser, opened as openedAt } from "./browser.mjs";
import { makeRoom, readGrey16, run, serve } from "./programs.mjs";

/** Small: without a GPU, every pixel of a picture takes its time. */
const [WIDTH, HEIGHT] = [700, 360];
const PANEL_PX = 360;
const FIELD_OF_VIEW_DEG = 55;
/** A photo of the test set, and a thing in it that the embedded models know. */
const [VIEW, THING] = [Number(process.env.SLAG_PAGE_VIEW ?? 3), process.env.SLAG_PAGE_THING ?? "armchair"];

const opened = (url, run, how = {}) => openedAt(url, run, { ...how, options: { viewport: { width: WIDTH, height: HEIGHT } } });

let room, store, robot;
before(async () => {
  await openBrowser();
  room = makeRoom();
  store = await serve("slag-encoder", ["serve", "--store", room.store, "--listen", "127.0.0.1:0"]);
  room.fetch(store.url);
  robot = await serve("slag-edge", ["serve", "--cache", room.cache, "--listen", "127.0.0.1:0"]);
});
after(async () => {
  await closeBrowser();
  await robot?.stop();
  await store?.stop();
  room?.close();
});

const drawn = (page) => page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, { timeout: 60000 });
const answered = (page, question) => page.waitForFunction((q) => document.documentElement.dataset.answered === q, question, { timeout: 60000 });

/** Pose of the test photo, and a function from a pixel of the page to the thing that the truth has there. */
function truth() {
  const poses = JSON.parse(readFileSync(join(room.room, "test/transforms.json"), "utf8"));
  const matrix = poses.frames[VIEW].transform_matrix;
  const position = matrix.slice(0, 3).map((row) => row[3]);
  // OpenGL's cameras look against z.
  const forward = matrix.slice(0, 3).map((row) => -row[2]);
  const mask = readGrey16(join(room.room, `gt/test_masks/${poses.frames[VIEW].file_path.split("/").pop()}`));
  const instances = JSON.parse(readFileSync(join(room.room, "gt/instances.json"), "utf8")).instances;
  const ids = instances.filter(({ category }) => category === THING).map(({ id }) => id);
  const focal = HEIGHT / 2 / Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
  const isThing = (x, y) => {
    const u = Math.round(((x - (PANEL_PX + WIDTH) / 2) / focal) * poses.fl_x + poses.cx);
    const v = Math.round(((y - HEIGHT / 2) / focal) * poses.fl_y + poses.cy);
    return u >= 0 && v >= 0 && u < mask.width && v < mask.height ? ids.includes(mask.at(u, v)) : null;
  };
  return { camera: [...position, ...position.map((v, i) => v + forward[i])].map((v) => v.toFixed(4)).join(","), isThing };
}

/**
 * Share of lit pixels that show the thing, give or take a few pixels, and share of the thing's pixels that are
 * lit.
 */
function judge(lit, isThing) {
  const isNear = (x, y) => [0, -6, 6].some((dx) => [0, -6, 6].some((dy) => isThing(x + dx, y + dy)));
  const known = lit.filter(([x, y]) => isThing(x, y) !== null);
  const found = new Set(lit.map(([x, y]) => y * WIDTH + x));
  let [nTrue, nFound] = [0, 0];
  for (let y = 0; y < HEIGHT; y++) for (let x = PANEL_PX; x < WIDTH; x++) {
    if (!isThing(x, y)) continue;
    nTrue++;
    if (found.has(y * WIDTH + x)) nFound++;
  }
  return { nTrue, precision: known.filter(([x, y]) => isNear(x, y)).length / Math.max(known.length, 1), recall: nFound / Math.max(nTrue, 1) };
}

for (const [name, service] of [["slag-edge", () => robot], ["slag-encoder", () => store]]) {
  test(`${name}: pixels that the question lights are those of the truth's mask`, () => {
    const { camera, isThing } = truth();
    return opened(service().url, async (page) => {
      await drawn(page);
      await answered(page, THING);
      await keepPicture(page, `${name}-answered`);
      const { nTrue, precision, recall } = judge(await litPixels(page, PANEL_PX, `${name}-lit`), isThing);
      console.log(`${name}: ${nTrue} pixels of ${THING}, precision ${precision.toFixed(3)}, recall ${recall.toFixed(3)}`);
      assert.ok(nTrue > 1000 && precision > 0.8 && recall > 0.6);
    }, { isLookedAt: true, fragment: `q=${THING}&camera=${camera}` });
  });
}

test("slag-edge: a click on an answer shows its place and photo, and what is absent is told", () => opened(robot.url, async (page) => {
  await drawn(page);
  await answered(page, THING);
  await page.locator("#answers .card").first().click();
  await page.locator("#details").getByText("Best photo").waitFor();
  await page.fill("#question", "an elephant");
  await answered(page, "an elephant");
  assert.equal(await page.locator("#answers .card").count(), 0);
  assert.match(await page.locator("#message").innerText(), /\w/);
}, { fragment: `q=${THING}` }));

test("slag-edge: places to stand are those of the robot's own route", () => opened(robot.url, async (page) => {
  await drawn(page);
  await answered(page, THING);
  const [{ answers: [{ id }] }] = (await (await fetch(`${robot.url}/v1/query?text=${THING}`)).json()).results;
  const reply = await (await fetch(`${robot.url}/v1/goal?id=${id}`)).json();
  await page.locator("#answers .card").first().click();
  await page.locator("#places").waitFor();
  const shown = await page.locator("#places button").allInnerTexts();
  assert.deepEqual(shown.map((text) => text.split(" m ")[0]), reply.goals.map(({ position_in_world: [x, y] }) => `${x.toFixed(2)}, ${y.toFixed(2)}`));
  if (reply.none) assert.match(await page.locator("#places").innerText(), new RegExp(reply.none.kind.replaceAll("-", " ")));
  assert.ok(reply.goals.length > 0 || reply.none);
}, { fragment: `q=${THING}` }));

test("slag-edge: suggested words have as many things as they are answered with", () => opened(robot.url, async (page) => {
  await drawn(page);
  await page.locator("#question").focus();
  const options = page.locator("#question-suggestions [role=option]");
  await options.first().waitFor();
  const suggested = await options.allInnerTexts();
  assert.ok(suggested.length > 2, String(suggested));
  for (const [word, note] of await options.evaluateAll((all) => all.map((option) => [...option.children].map((part) => part.textContent)))) {
    const [{ answers }] = (await (await fetch(`${robot.url}/v1/query?limit=1000&text=${encodeURIComponent(word)}`)).json()).results;
    assert.equal(note, String(answers.length), word);
  }
}));

test("slag-edge: cameras are where the poses say, without pictures", () => opened(robot.url, async (page) => {
  await drawn(page);
  const { frames } = JSON.parse(readFileSync(join(room.room, "transforms.json"), "utf8"));
  const { views } = await (await fetch(`${robot.url}/v1/view`)).json();
  assert.equal(views.length, frames.length);
  for (const { name, position_m, rotation_xyzw: [x, y, z, w], has_picture } of views) {
    const { transform_matrix: matrix } = frames.find(({ file_path }) => file_path.endsWith(name));
    // The camera's z is forward, where OpenGL's cameras look against z.
    const forward = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
    for (const k of [0, 1, 2]) assert.ok(Math.abs(position_m[k] - matrix[k][3]) < 1e-4 && Math.abs(forward[k] + matrix[k][2]) < 1e-4, `${name}: ${position_m}, ${forward}`);
    assert.equal(has_picture, false);
  }
  assert.ok(await page.locator("#photos-label").evaluate((label) => !label.hidden));
}));

test("slag-encoder view: the photo has the answer's box, and a second question is beside the first", NIGHTLY, async () => {
  const viewer = await serve("slag-encoder", ["view", "--store", room.store, "--scene", join(room.room, "scene.ply"),
    "--views", join(room.room, "transforms.json"), "--listen", "127.0.0.1:0", "--no-open"]);
  try {
    await opened(viewer.url, async (page) => {
      await drawn(page);
      await answered(page, `${THING} | wall`);
      assert.ok(await page.locator("#photos-label").evaluate((label) => !label.hidden));
      await page.locator("#answers .card").first().click();
      await page.locator("#details figure rect").waitFor();
      await page.getByRole("button", { name: "Stand here" }).click();
      await page.locator("#blend-share").fill("60");
      await page.waitForFunction(() => !document.getElementById("blend").hidden && document.getElementById("blend").naturalWidth > 0);
      await keepPicture(page, "photo-blended");
    }, { fragment: `q=${THING}&and=wall` });
  } finally {
    await viewer.stop();
  }
});

test("slag-encoder view: a splat alone is drawn and not asked", async () => {
  const viewer = await serve("slag-encoder", ["view", "--scene", join(room.room, "scene.ply"), "--listen", "127.0.0.1:0", "--no-open"]);
  try {
    await opened(viewer.url, async (page) => {
      await drawn(page);
      assert.ok(await page.locator("#ask").isHidden());
    });
  } finally {
    await viewer.stop();
  }
});

test("another generation is told while the page is open, and a robot that goes and comes back", NIGHTLY, () => opened(robot.url, async (page) => {
  await drawn(page);
  room.encodeAnother();
  room.fetch(store.url);
  await page.getByText("generation 2 now").waitFor({ timeout: 30000 });
  await answered(page, THING);
  // The store's page counts like its program's command, the robot's like its route.
  const { appeared, went, moved, n_same, n_stayed } = JSON.parse(run("slag-encoder", ["diff", room.store, "--json"]));
  assert.ok(appeared.length + went.length + moved.length > 0);
  await opened(store.url, async (of) => {
    await drawn(of);
    await layer(of, "changes", true);
    await of.locator("#changes").getByText(`${appeared.length} appeared, ${went.length} went, ${moved.length} moved, ${n_same + n_stayed} stayed`).waitFor();
    assert.equal(await of.locator("#changes button").count(), appeared.length + went.length + moved.length);
  });
  const ofRobot = await (await fetch(`${robot.url}/v1/changes`)).json();
  await layer(page, "changes", true);
  const kinds = ["appeared", "went", "moved"];
  await page.locator("#changes").getByText(kinds.map((kind) => `${ofRobot[kind].length} ${kind}`).join(", ")).waitFor();
  const at = robot.url;
  await robot.stop();
  await page.getByText("cannot be reached").waitFor({ timeout: 30000 });
  robot = await serve("slag-edge", ["serve", "--cache", room.cache, "--listen", at.replace("http://", "")]);
  await page.getByText("service is back").waitFor({ timeout: 30000 });
}, { fragment: `q=${THING}`, expected: /ERR_|Failed to fetch|network error/ }));
