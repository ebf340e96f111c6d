// First impression and chosen answers: the scene fills the screen, nothing covers the chosen answer, and lit and unlit
// differ for every eye.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { closeBrowser, layer, openBrowser, picture, pixels } from "./browser.mjs";
import { answered, CAMERA, cameraOf, drawn, isInside, litPixels, minus, opened, PANEL_PX, project, WIDTH } from "./scene.mjs";
import { THINGS } from "./service.mjs";

before(openBrowser);
after(closeBrowser);

const CHAIR = THINGS.find(({ name }) => name === "chair");
/** Looks from the west at the chair, a little downward. */
const PHOTO = { name: "west/1.jpg", position_m: [-2.5, 0.8, 1.5], rotation_xyzw: [-0.561451, 0.561451, -0.429852, 0.429852], width_px: 640, height_px: 480, focal_px: 500, has_picture: true };
const EVIDENCE = { photo: PHOTO.name, box_px: [400, 200, 500, 300] };
const PHONE = { viewport: { width: 390, height: 844 }, hasTouch: true };

/** Shares of the screen that show the scene: it is grey, and the ground around it is bluish. */
async function coverage(page, { width, height }) {
  await layer(page, "grid", false);
  const found = await pixels(page, 0, (r, g, b) => Math.abs(r - g) < 4 && Math.abs(g - b) < 4 && r > 60);
  const panel = await page.locator("#panel").boundingBox();
  const isPanel = ([x, y]) => x >= panel.x && x < panel.x + panel.width && y >= panel.y && y < panel.y + panel.height;
  return found.filter((pixel) => !isPanel(pixel)).length / (width * height);
}

for (const [name, options] of [["wide", { viewport: { width: 960, height: 540 } }], ["phone", PHONE]]) {
  test(`the opening view shows the scene over at least half of the screen: ${name}`, () => opened(async (page) => {
    await page.waitForFunction(() => document.documentElement.dataset.wholePictureMs !== undefined);
    const share = await coverage(page, options.viewport);
    console.log(`${name}: ${(100 * share).toFixed(0)} % of the screen`);
    // Far strays do not move it away.
    assert.ok(share > 0.5, String(share));
  }, { isLookedAt: true, behaviour: { things: [...THINGS, { name: "stray", min: [300, 300, 90], max: [302, 302, 92], n: [2, 2, 2] }], position: null, program: "slag-encoder" }, options }));

  test(`the chosen answer is never behind the panel: ${name}`, () => opened(async (page) => {
    await drawn(page);
    for (const thing of ["chair", "ball"]) {
      await page.fill("#question", thing);
      await answered(page, thing);
      await page.locator("#answers .card").click();
      await page.locator("#details").waitFor();
      await page.locator("#labels .chosen").waitFor();
      await layer(page, "boxes", false);
      const lit = await pixels(page, 0, "(r, g, b) => r > 90 && r - Math.min(g, b) > 45");
      const panel = await page.locator("#panel").boundingBox();
      const isFree = ([x, y]) => options.hasTouch ? y < panel.y : x > panel.x + panel.width;
      const free = lit.filter(isFree);
      const { width, height } = options.viewport;
      const middle = options.hasTouch ? [width / 2, panel.y / 2] : [(panel.x + panel.width + width) / 2, height / 2];
      const mean = [0, 1].map((axis) => free.reduce((sum, pixel) => sum + pixel[axis], 0) / free.length);
      assert.ok(free.length > 1500 && Math.hypot(mean[0] - middle[0], mean[1] - middle[1]) < 60, `${thing}: ${free.length} lit around ${mean}, not ${middle}`);
      await layer(page, "boxes", true);
    }
  }, { isLookedAt: true, behaviour: { goal: "unreachable" }, options }));
}

test("cards have the photo's crop, whereabouts, size and how sure; the chosen one shows the photo with its box first", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  const card = page.locator("#answers .card");
  await card.locator("svg.crop").waitFor();
  const [x, y, width, height] = (await card.locator("svg.crop").getAttribute("viewBox")).split(" ").map(Number);
  const [left, top, right, bottom] = EVIDENCE.box_px;
  assert.ok(x <= left && y <= top && x + width >= right && y + height >= bottom && width < 200, `${x} ${y} ${width} ${height}`);
  assert.match(await card.innerText(), /chair\s+4\.8 m from the robot\s+1\.4 × 0\.6 × 1\.0 m\s+strong/);
  await card.click();
  await page.locator("#details figure rect").waitFor();
  assert.equal(await page.locator("#answers li #details > :first-child").evaluate((first) => first.tagName), "FIGURE");
  const box = await page.locator("#details rect").evaluate((rect) => ["x", "y", "width", "height"].map((name) => Number(rect.getAttribute(name))));
  assert.deepEqual(box, [400, 200, 100, 100]);
  // It looks from the photo's position, not from farther away.
  const [from, to] = await cameraOf(page);
  const along = [0, 1, 2].map((k) => (from[k] - to[k]) / Math.hypot(...from.map((v, i) => v - to[i])));
  const toPhoto = PHOTO.position_m.map((v, k) => v - to[k]);
  assert.ok(along.reduce((sum, v, k) => sum + (v * toPhoto[k]) / Math.hypot(...toPhoto), 0) > 0.999, `${from}, ${to}`);
  await page.getByRole("button", { name: "ROS" }).click();
  await page.locator(".copies").getByText(/Copied/).or(page.locator(".copies textarea")).first().waitFor();
  await page.keyboard.press("Escape");
  assert.ok(await page.locator("#details").isHidden());
}, { behaviour: { photos: [PHOTO], evidence: EVIDENCE, goal: "unreachable" }, fragment: `q=chair&camera=${CAMERA}` }));

test("where photos are not at hand, answers have the small picture that the scene carries", () => opened(async (page) => {
  await answered(page, "chair");
  const picture = page.locator("#answers .card img.crop");
  await picture.waitFor();
  await page.waitForFunction(() => document.querySelector("#answers .card img").naturalWidth > 0);
  await page.locator("#answers .card").first().click();
  assert.ok(await picture.isVisible());
}, { behaviour: { photos: [{ ...PHOTO, has_picture: false }], evidence: { ...EVIDENCE, has_thumbnail: true }, goal: "unreachable" }, fragment: `q=chair&camera=${CAMERA}` }));

test("what no object answers, groups of what is lit do; what nothing answers lights nothing, nor does a failure", () => opened(async (page, service) => {
  await drawn(page);
  await answered(page, "seat");
  await page.getByText("1 place matches, which is not marked as an object.").waitFor();
  assert.match(await page.locator("#answers .card").innerText(), /seat[^]*1\.\d × 0\.\d × 0\.9 m/);
  assert.ok((await litPixels(page)).filter((pixel) => isInside(CHAIR, pixel, 8)).length > 2000);
  await page.fill("#question", "unicorn");
  await answered(page, "unicorn");
  assert.equal((await litPixels(page)).length, 0);
  assert.ok(await page.locator("#legend").isHidden());
  await page.fill("#question", "chair");
  await answered(page, "chair");
  service.behaviour.fails = true;
  await page.fill("#question", "ball");
  await page.getByText("too busy").waitFor();
  assert.deepEqual([(await litPixels(page)).length, await page.locator("#answers .card").count()], [0, 0]);
}, { isLookedAt: true, fragment: `q=seat&camera=${CAMERA}`, expected: /503/ }));

/** Luminance of a colour (WCAG 2.2). */
const luminance = (colour) => colour.map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)).reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);

test("lit and unlit differ by 3 to 1 in lightness in every theme, and for eyes that see no red, green or blue", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  await layer(page, "boxes", false);
  await layer(page, "grid", false);
  const devtools = await page.context().newCDPSession(page);
  const FLOOR = { name: "floor", min: [2, -3, -0.1], max: [3.5, -1.5, 0] };
  const ramp = () => page.locator("#ramp").evaluate((canvas) => canvas.toDataURL());
  const ramps = new Set();
  for (const theme of ["dark", "light", "contrast"]) {
    ramps.add(await ramp());
    assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), theme);
    for (const type of ["none", "protanopia", "deuteranopia", "tritanopia"]) {
      await devtools.send("Emulation.setEmulatedVisionDeficiency", { type });
      const colours = await picture(page).then((png) => meanColours(page, png.toString("base64"), [CHAIR, FLOOR]));
      const [lit, unlit] = colours.map(luminance);
      const ratio = (Math.max(lit, unlit) + 0.05) / (Math.min(lit, unlit) + 0.05);
      console.log(`${theme}, ${type}: ${ratio.toFixed(1)} to 1`);
      assert.ok(ratio > 3, `${theme}, ${type}: ${ratio}`);
    }
    await devtools.send("Emulation.setEmulatedVisionDeficiency", { type: "none" });
    await page.click("#theme");
  }
  assert.equal(ramps.size, 3);
}, { isLookedAt: true, fragment: `q=chair&camera=${CAMERA}` }));

/** Mean colours inside of things' outlines, away from their edges. */
async function meanColours(page, png, things) {
  const inside = things.map((thing) => {
    const found = [];
    for (let x = PANEL_PX; x < WIDTH; x += 3) for (let y = 0; y < 640; y += 3) if (isInside(thing, [x, y], -12)) found.push([x, y]);
    return found;
  });
  return page.evaluate(async ([data, all]) => {
    const image = await createImageBitmap(new Blob([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))]));
    const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
    context.drawImage(image, 0, 0);
    const { data: rgba, width } = context.getImageData(0, 0, image.width, image.height);
    return all.map((points) => [0, 1, 2].map((k) => points.reduce((sum, [x, y]) => sum + rgba[4 * (y * width + x) + k], 0) / points.length));
  }, [png, inside]);
}

test("keys: the list of them, measuring, hovering, and the opening view again", () => opened(async (page) => {
  await drawn(page);
  await page.keyboard.press("?");
  await page.locator("#keys").getByText("opening view").waitFor();
  assert.equal(await page.evaluate(() => document.activeElement.id), "keys-title");
  await page.keyboard.press("Escape");
  await page.keyboard.press("m");
  // Two places on the floor, 2 m apart.
  const at = (point) => page.mouse.click(...project(point));
  await at([-1, 2, 0]);
  await page.getByText("Click the second point.").waitFor();
  await at([-3, 2, 0]);
  const said = await page.locator("#notice").innerText();
  assert.ok(Math.abs(Number.parseFloat(said) - 2) < 0.2, said);
  await page.keyboard.press("m");
  await page.mouse.move(...project([1.2, 0.5, 0.7]));
  await page.locator("#hover").waitFor();
  assert.match(await page.locator("#hover").innerText(), /\d cm above ground$/);
  await page.mouse.move(740, 639);
  await page.locator("#hover").waitFor();
  const { y, height } = await page.locator("#hover").boundingBox();
  assert.ok(y + height <= 640, `${y} + ${height}`);
  const [before] = await cameraOf(page);
  await page.locator("#canvas").focus();
  await page.keyboard.press("r");
  await page.waitForTimeout(300);
  assert.notDeepEqual((await cameraOf(page))[0], before);
}, { fragment: `camera=${CAMERA}` }));

const MANY = Array.from({ length: 30 }, (_, i) => ({ word: `thing ${i}`, n_things: 30 - i }));

test("an arrow leads to what is out of view, a chip lists all that is on board", () => opened(async (page) => {
  await drawn(page);
  const chips = page.locator("#chips button");
  assert.equal(await chips.first().innerText(), "all30");
  await chips.first().click();
  assert.deepEqual([await chips.count(), await chips.last().innerText()], [30, "thing 291"]);
  // It looks at the chair and the ball, then turns half round to the left.
  await page.fill("#question", "chair");
  await page.click("#more");
  await page.fill("#second", "ball");
  await answered(page, "chair | ball");
  await page.locator("#labels .second:not(.beyond)").getByText("ball").waitFor();
  const label = page.locator("#labels .answer");
  await label.waitFor();
  assert.ok(!(await label.getAttribute("class")).includes("beyond"));
  await page.locator("#canvas").focus();
  await page.keyboard.down("ArrowLeft");
  await page.locator("#labels .answer.beyond").waitFor();
  await page.locator("#labels .second.beyond").waitFor();
  const second = await page.locator("#labels .second").boundingBox();
  assert.ok(second.x >= PANEL_PX && second.x + second.width <= WIDTH, `${second.x} + ${second.width}`);
  await page.keyboard.up("ArrowLeft");
  const { x, width } = await label.boundingBox();
  assert.ok(x + width > WIDTH - 30 && x + width <= WIDTH, `the right edge: ${x} + ${width}`);
  // The scale in the corner stays free.
  await page.evaluate(() => { location.hash = "q=chair&camera=0.5,-6,4,-4,2,4.5"; });
  await page.waitForFunction(() => document.querySelector("#labels .answer.beyond")?.getBoundingClientRect().y > 500);
  const [low, scale] = [await label.boundingBox(), await page.locator("#hud").boundingBox()];
  assert.ok(low.x + low.width > scale.x && low.y + low.height <= scale.y, `${low.y} + ${low.height}, ${scale.y}`);
}, { behaviour: { words: MANY }, fragment: `camera=${CAMERA}` }));

/** A floor, and a terrace 2 m above it. */
const STEPPED = [THINGS[0], { name: "terrace", min: [4, -4, 1.9], max: [12, 4, 2], n: [64, 64, 1] }];

test("heights are over the ground that lies below, which need not be level", () => opened(async (page) => {
  await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined);
  await page.mouse.move(...project([8, 0, 1.95], [8, -8, 6], [8, 0, 2]));
  await page.locator("#hover").waitFor();
  assert.match(await page.locator("#hover").innerText(), /^\d cm above ground$/);
}, { behaviour: { things: STEPPED }, fragment: "camera=8,-8,6,8,0,2" }));

test("a pointer meets large Gaussians anywhere on them, and measuring says where there is nothing", () => opened(async (page) => {
  await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined);
  const at = (point) => page.mouse.click(...project(point));
  await page.keyboard.press("m");
  // Between the middles of four, which are 2 m apart.
  await at([0, 2, 0]);
  await page.getByText("Click the second point.").waitFor();
  await page.mouse.click(600, 20);
  await page.getByText("Nothing there: click on a surface.").waitFor();
  await at([-2, 2, 0]);
  await page.getByText("between the two points").waitFor();
  const said = await page.locator("#notice").innerText();
  assert.ok(Math.abs(Number.parseFloat(said) - 2) < 0.1, said);
  await page.keyboard.press("m");
  await page.mouse.move(...project([0, 2, 0]));
  await page.locator("#hover").waitFor();
}, { behaviour: { things: [{ ...THINGS[0], n: [4, 4, 1] }] }, fragment: `camera=${CAMERA}` }));

test("standing where a photo was taken, the scale is that of what is in the middle", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  await page.locator("#answers .card").click();
  await page.getByRole("button", { name: "Stand here" }).click();
  const [position, target] = await cameraOf(page);
  // The photo's middle shows the floor behind the chair's edge, or the chair: not 1.1 m before it.
  assert.deepEqual(position, PHOTO.position_m);
  assert.ok(Math.hypot(...minus(target, position)) > 2.5, `looks at ${target}`);
}, { behaviour: { photos: [PHOTO], evidence: EVIDENCE, goal: "unreachable" }, fragment: `q=chair&camera=${CAMERA}` }));

test("on a phone layers lie over the compass, chips are whole, and answers have the header's room", () => opened(async (page) => {
  await drawn(page);
  const rows = await page.locator("#chips").evaluate((chips) => {
    const { bottom } = chips.getBoundingClientRect();
    return [...chips.children].map((chip) => chip.getBoundingClientRect()).filter(({ top }) => top < bottom).map((chip) => Math.round(bottom - chip.bottom));
  });
  assert.ok(rows.length > 3 && rows.every((left) => left >= 0), String(rows));
  await page.locator("#layers summary").click();
  const top = await page.locator("#show-boxes").evaluate((box) => {
    const { x, y } = box.parentElement.getBoundingClientRect();
    document.getElementById("hud").style.pointerEvents = "auto";
    return document.elementFromPoint(x + 2, y + 4).closest("#hud, #layers").id;
  });
  assert.equal(top, "layers");
  const summary = page.locator("#layers summary");
  for (const close of [() => page.keyboard.press("Escape"), () => page.locator("#facts").click(), () => page.keyboard.press("?")]) {
    await close();
    assert.ok(await page.locator("#show-boxes").isHidden(), String(close));
    await page.keyboard.press("Escape");
    await summary.click();
  }
  await summary.click();
  await page.fill("#question", "chair");
  await answered(page, "chair");
  assert.ok(await page.locator("#facts").isHidden());
  const { y, height } = await page.locator("#answers .card").first().boundingBox();
  assert.ok(y + height <= 844, `${y + height}`);
  // The open answer's photo is whole, the handle stays, and nothing covers the larger panel.
  await page.locator("#answers .card").tap();
  const photo = page.locator("#details figure svg");
  await photo.waitFor();
  assert.equal(await photo.evaluate((svg) => svg.getBoundingClientRect().bottom <= innerHeight), true);
  await page.getByRole("button", { name: "Larger panel" }).tap();
  assert.ok(await page.locator("#tools").isHidden());
  await page.locator("#places").scrollIntoViewIfNeeded();
  await page.getByRole("button", { name: "Smaller panel" }).tap();
}, { behaviour: { photos: [PHOTO], evidence: EVIDENCE, goal: "unreachable", words: ["mirror", "window", "dog", "pallet", "chair", "excavator", "pipe", "table", "bookshelf", "floor", "bench", "log"].map((word) => ({ word, n_things: 3 })) }, options: { ...PHONE, isMobile: true } }));

test("a photo given to the page is found by the robot: the page stands there, and lays it over", () => opened(async (page, service) => {
  await drawn(page);
  const photo = { name: "here.png", mimeType: "image/png", buffer: await page.screenshot() };
  service.behaviour.located = { state: "lost", reason: "too few features" };
  await page.locator("#photo").setInputFiles(photo);
  await page.locator("#notice").getByText("Lost: too few features").waitFor();
  const widthPx = photo.buffer.readUInt32BE(16);
  assert.ok(Math.abs(service.behaviour.focalPx - widthPx / 2 / Math.tan((65 * Math.PI) / 360)) < 0.1, `focal length ${service.behaviour.focalPx}`);
  // At (0, -3, 1), looking along y: x right, z up.
  service.behaviour.located = { state: "found", position_in_world: [0, -3, 1], optical_rotation_xyzw: [-Math.SQRT1_2, 0, 0, Math.SQRT1_2], n_inliers: 57 };
  await page.locator("#details input[type=number]").fill("300");
  await page.locator("#details").getByText("Find its place").click();
  await page.locator("#notice").getByText("Found by 57 landmarks").waitFor();
  assert.equal(service.behaviour.focalPx, 300);
  const [position, target] = await cameraOf(page);
  assert.ok(Math.hypot(...minus(position, [0, -3, 1])) < 0.01, `stands at ${position}`);
  const looks = minus(target, position);
  assert.ok(looks[1] > 0.99 * Math.hypot(...looks), `looks along ${looks}`);
  await page.locator("#blend-share").fill("50");
  assert.equal(await page.locator("#blend").isVisible(), true);
}, { behaviour: { goal: "unreachable" }, fragment: `camera=${CAMERA}` }));

test("the robot is named, with its age and heading; a lost service has a badge; a click asks for what is under it", () => opened(async (page, service) => {
  await drawn(page);
  await page.locator("#labels .robot").getByText("Robot").waitFor();
  await page.getByText("Robot, the green mark · scene 2 h old · 80 cm around it on board").waitFor();
  await page.mouse.click(...project([-1.5, -1.5, 0.5]));
  await page.locator("#details").getByText("-1.50, -1.00, 0.50 m").waitFor();
  await page.locator("#details").getByText("ball 81 %").waitFor();
  service.behaviour.isGone = true;
  await page.locator("#badge").getByText("offline").waitFor({ timeout: 15000 });
}, { behaviour: { goal: "unreachable" }, fragment: `camera=${CAMERA}`, expected: /ERR_/ }));

test("a clicked object that answers the question is that answer; another has no score, and Esc brings the answers back", () => opened(async (page) => {
  await drawn(page);
  await answered(page, "chair");
  const clickAt = async (point, ...camera) => page.mouse.click(...project(point, ...camera));
  const card = page.locator("#answers .card");
  await clickAt([-1.5, -1.5, 0.5]);
  await card.getByText("ball").waitFor();
  assert.doesNotMatch(await page.locator("#answers").innerText(), /Score|weak/);
  const ofBall = await cameraOf(page);
  await page.keyboard.press("Escape");
  await card.getByText("strong").waitFor();
  assert.equal(await page.locator("#message").innerText(), "1 found");
  await clickAt([-1.5, -1, 0.95], ...ofBall);
  await card.getByText("ball").waitFor();
  await clickAt([1.2, 0.8, 0.9], ...ofBall);
  await page.locator("#answers .chosen").getByText("strong").waitFor();
  assert.match(await page.locator("#details").innerText(), /Score/);
}, { behaviour: { goal: "unreachable" }, fragment: `q=chair&camera=${CAMERA}` }));
