// Asking with suggestions, and places to stand near what was found, over the small known scene.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { axe, closeBrowser, layer, openBrowser, pixels } from "./browser.mjs";
import { answered, CAMERA, cameraOf, drawn, opened, PANEL_PX, project } from "./scene.mjs";
import { GOALS } from "./service.mjs";

before(openBrowser);
after(closeBrowser);

const ROBOT_RADIUS_M = 0.3;
const isViolet = (r, g, b) => Math.abs(r - 0xc7) < 14 && Math.abs(g - 0x7d) < 14 && Math.abs(b - 0xff) < 14;

test("a thing's places to stand are drawn on the ground with their directions, and a click looks from there", () => opened(async (page, service) => {
  await drawn(page);
  await answered(page, "chair");
  await page.locator("#answers .card").click();
  await page.locator("#places button").first().waitFor();
  assert.ok(service.behaviour.requests.includes("/v1/goal?id=o1&radius_m=0.3"));
  assert.deepEqual(await page.locator("#places button").allInnerTexts(), [
    "1.20, -1.00 m · sees 61 % · clear by 0.75 m · way 4.3 m", "-0.20, 0.90 m · sees 44 % · clear by 0.52 m · way 5.5 m",
  ]);
  await layer(page, "boxes", false);
  const [from, to] = await cameraOf(page);
  const violet = await pixels(page, PANEL_PX, isViolet, "places");
  for (const { position_in_world: [x, y, z], yaw_rad } of GOALS) {
    // The nose is filled ahead of the middle; behind it, only the outline is drawn.
    const isFilled = (along) => {
      const [u, v] = project([x + along * ROBOT_RADIUS_M * Math.cos(yaw_rad), y + along * ROBOT_RADIUS_M * Math.sin(yaw_rad), z], from, to);
      assert.ok(u > PANEL_PX && v > 0, `outside the picture: ${u}, ${v}`);
      return violet.some(([a, b]) => Math.hypot(a + 0.5 - u, b + 0.5 - v) < 1.5);
    };
    assert.deepEqual([0.5, 0, -0.4, -0.8].map(isFilled), [true, true, true, false], `${x}, ${y}`);
  }
  const [u, v] = project(GOALS[1].position_in_world, from, to);
  await page.mouse.click(u, v);
  await page.locator("#places button[aria-pressed=true]").filter({ hasText: "-0.20, 0.90" }).waitFor();
  assert.deepEqual(await cameraOf(page), [GOALS[1].sensor_in_world, [1.2, 0.8, 0.5]]);
}, { isLookedAt: true, behaviour: { goal: "reached" }, fragment: `q=chair&camera=${CAMERA}` }));

for (const [goal, said, id = "o1"] of [["unreachable", "None: unreachable."], ["not-visible", "None: not visible."], ["no-occupancy", "encode it with --occupancy"], ["reached", "a group of Gaussians", "15-6129"]]) {
  test(`a plain message where there is no place to stand: ${goal} ${id}`, () => opened(async (page) => {
    await drawn(page);
    await answered(page, "chair");
    await page.locator("#answers .card").click();
    await page.locator("#places").getByText(said).waitFor();
    assert.equal(await page.locator("#places button").count(), 0);
  }, { behaviour: { goal, id }, fragment: "q=chair", expected: /409/ }));
}

test("keys choose a suggestion, and screen readers are told which", () => opened(async (page) => {
  await drawn(page);
  const box = page.getByRole("combobox", { name: "Ask the scene" });
  await box.focus();
  const options = page.locator("#question-suggestions [role=option]");
  // Without input: objects on board only.
  assert.deepEqual(await options.allInnerTexts(), ["chair1", "ball1"]);
  await box.pressSequentially("wa");
  assert.deepEqual(await options.allInnerTexts(), ["wall", "red wall"]);
  assert.equal(await box.getAttribute("aria-expanded"), "true");
  assert.equal(await box.getAttribute("aria-activedescendant"), null);
  await page.keyboard.press("ArrowUp");
  const active = page.locator(`[id="${await box.getAttribute("aria-activedescendant")}"]`);
  assert.deepEqual([await active.innerText(), await active.getAttribute("aria-selected")], ["red wall", "true"]);
  const found = await page.evaluate(`(() => { ${axe}; return axe.run("#ask"); })()`);
  assert.deepEqual(found.violations.map(({ id, nodes }) => `${id}: ${nodes[0].html}`), []);
  await page.keyboard.press("ArrowUp");
  await page.keyboard.press("Enter");
  await answered(page, "wall");
  assert.deepEqual([await box.inputValue(), await box.getAttribute("aria-expanded"), await options.count()], ["wall", "false", 0]);
  // The unfinished negative is completed, and the words before it stay.
  await box.fill("chair -ba");
  assert.deepEqual(await options.allInnerTexts(), ["chair -ball1"]);
  await page.keyboard.press("Escape");
  assert.deepEqual([await options.count(), await box.inputValue()], [0, "chair -ba"]);
  // This model lists what it knows, and refuses other phrases.
  for (const line of ["soft cha", "chair -re"]) {
    await box.fill(line);
    assert.equal(await options.count(), 0, line);
  }
  await box.fill("");
  assert.ok((await options.allInnerTexts()).includes("wallbefore"));
  await page.waitForTimeout(300);
  assert.ok(await page.locator("#chips").isHidden());
}));

test("a click chooses a suggestion, and a second question has its own", () => opened(async (page, service) => {
  await drawn(page);
  await page.click("#more");
  await page.locator("#second").pressSequentially("b");
  await page.locator("#second-suggestions").getByText("ball").click();
  await answered(page, "ball");
  assert.ok(await page.locator("#question-suggestions").isHidden());
  assert.ok(service.behaviour.requests.includes("/v1/view/scores?text=ball"));
  // One that is refused leaves the other's answers.
  await page.fill("#question", "chair");
  await answered(page, "chair | ball");
  await page.fill("#second", "bal");
  await page.locator("#second-legend").getByText("is not one of").waitFor();
  assert.equal(await page.locator("#answers .card").count(), 1);
  // Words that the model knows are a click away.
  await page.fill("#second", "");
  await page.fill("#question", "bal -wall");
  await page.locator("#message").getByRole("button", { name: "ball" }).click();
  await answered(page, "ball -wall");
}, { behaviour: { refused: { text: "bal", detail: '"bal" is not one of the 5 phrases this model knows; did you mean ball, wall?' } }, expected: /422/ }));

// For a model that takes any text, everyday words are counted, some at a time.
test("things on board are suggested of a model without a list of words, as they are counted", () => opened(async (page, service) => {
  await drawn(page);
  await page.locator("#question").focus();
  const options = page.locator("#question-suggestions [role=option]");
  await options.getByText("chair").waitFor();
  assert.deepEqual(await options.allInnerTexts(), ["chair1"]);
  Object.assign(service.behaviour, { words: [{ word: "chair", n_things: 1 }, { word: "street lamp", n_things: 2 }], hasAllWords: true });
  await options.getByText("street lamp").waitFor({ timeout: 15000 });
  await page.locator("#question").fill("tree");
  assert.deepEqual(await options.allInnerTexts(), []);
  await page.locator("#question").fill("");
  await page.locator("#question").pressSequentially("lamp");
  assert.deepEqual(await options.allInnerTexts(), ["street lamp2"]);
  const asked = () => service.behaviour.requests.filter((path) => path === "/v1/view/words").length;
  const n = asked();
  // It has looked again, and asks no more.
  const looked = service.behaviour.requests.length;
  await page.waitForFunction(() => performance.getEntriesByType("resource").filter(({ name }) => name.endsWith("/v1/view")).length > 3, null, { timeout: 30000 });
  assert.ok(service.behaviour.requests.length > looked);
  assert.equal(asked(), n);
}, { behaviour: { words: [{ word: "chair", n_things: 1 }], hasAllWords: false } }));

test("a link shows the same questions, threshold and camera to others", () => opened(async (page) => {
  await drawn(page);
  await page.fill("#question", "chair");
  await answered(page, "chair");
  await page.click("#more");
  await page.fill("#second", "ball");
  await answered(page, "chair | ball");
  await page.locator("#threshold").fill("200");
  const shown = async (of) => [await of.inputValue("#question"), await of.inputValue("#second"), await of.inputValue("#threshold"), ...(await cameraOf(of))];
  const first = await shown(page);
  // News of the link leaves the number of answers in place.
  await page.locator("#notice").getByText("The link is copied.").waitFor();
  assert.equal(await page.locator("#message").innerText(), "1 found");
  const other = await page.context().newPage();
  await other.goto(page.url());
  await drawn(other);
  await answered(other, "chair | ball");
  assert.deepEqual(await shown(other), first);
  assert.deepEqual(first.slice(0, 3), ["chair", "ball", "200"]);
  // In the same tab, too; and a question that has stood for a while is a step back.
  await page.evaluate(() => { location.hash = "q=wall"; });
  await page.getByText("nothing found").waitFor();
  await page.goBack();
  await answered(page, "chair | ball");
  assert.deepEqual(await shown(page), first);
  await page.waitForTimeout(2100);
  await page.fill("#second", "");
  await page.fill("#question", "ball");
  await answered(page, "ball");
  await page.goBack();
  await answered(page, "chair | ball");
  // Both are lit, each in its own colours.
  for (const [colour, n] of [["(r, g, b) => r > 90 && r - Math.min(g, b) > 45", 2000], ["(r, g, b) => b > 90 && b - r > 45", 2000]]) {
    assert.ok((await pixels(other, PANEL_PX, colour)).length > n, colour);
  }
}, { isLookedAt: true, options: { permissions: ["clipboard-read", "clipboard-write"] }, fragment: `camera=${CAMERA}` }));
