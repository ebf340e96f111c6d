// The page of `encode --view` in Chromium while the program encodes a room that slag-lab generates, and the file of `encode --report`.

import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { closeBrowser, openBrowser, opened, openedFile } from "./browser.mjs";
import { generateRoom, run, serve } from "./programs.mjs";

const N_VIEWS = 8;
const WAIT = { timeout: 300000 };

let room;
before(async () => {
  await openBrowser();
  room = generateRoom(N_VIEWS);
});
after(async () => {
  await closeBrowser();
  room?.close();
});

test("slag-encoder encode: --view shows the encode, then the scene; --report has it in one file; the bytes are those without both", async () => {
  const { frames } = JSON.parse(readFileSync(join(room.room, "transforms.json"), "utf8"));
  const broken = frames[N_VIEWS - 1].file_path;
  writeFileSync(join(room.room, broken), "not a photo");
  const flags = ["encode", "--scene", join(room.room, "scene.ply"), "--views", join(room.room, "transforms.json"), "--metric"];
  const [store, report] = ["watched", "report.html"].map((name) => join(room.folder, name));
  const encode = await serve("slag-encoder", [...flags, "--store", store, "--report", report, "--view", "--no-open", "--view-listen", "127.0.0.1:0", "--json", "--quiet"]);
  let summary, answers;
  try {
    await opened(encode.url, async (page) => {
      await page.locator("#work circle").first().waitFor(WAIT);
      await page.locator("#work img").first().waitFor(WAIT);
      await page.locator("#work").getByText("Generation 1 is published.").waitFor(WAIT);
      await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined, null, WAIT);
      // The summary is printed when the report is written.
      for (let i = 0; i < 100 && !encode.said().includes("}\n"); i++) await page.waitForTimeout(100);
      summary = JSON.parse(encode.said());
      const classes = await page.locator("#work circle").evaluateAll((all) => all.map((circle) => circle.getAttribute("class")));
      assert.deepEqual(classes.sort(), [...Array(N_VIEWS - 1).fill("done"), "left-out"]);
      // The map has each camera where its pose is, x to the right and y up, and the one that was left out is the broken photo's.
      const circles = await page.locator("#work circle").evaluateAll((all) => all.map((c) => ({ state: c.getAttribute("class"), x: Number(c.getAttribute("cx")), y: -Number(c.getAttribute("cy")) })));
      const poses = frames.map((frame) => ({ broken: frame.file_path === broken, x: frame.transform_matrix[0][3], y: frame.transform_matrix[1][3] }));
      const least = (all, axis) => Math.min(...all.map((one) => one[axis]));
      const [px, m] = [circles, poses].map((all) => Math.max(...all.map(({ x }) => x)) - least(all, "x"));
      for (const pose of poses) {
        const off = (c) => Math.hypot(...["x", "y"].map((axis) => ((c[axis] - least(circles, axis)) * m) / px - pose[axis] + least(poses, axis)));
        assert.ok(circles.some((c) => off(c) < 0.02 * m && (c.state === "left-out") === pose.broken), JSON.stringify({ pose, circles }));
      }
      const shown = await page.locator("#work img").evaluateAll((all) => all.map((image) => image.naturalWidth));
      assert.ok(shown.length > 0 && shown.every((width) => width > 100), String(shown));
      await page.locator("#work").getByText("is left out:").waitFor();
      answers = (await (await fetch(`${encode.url}/v1/query?text=sofa&limit=1000`)).json()).results[0].answers;
    }, { expected: /50[03]|404/ });
  } finally {
    await encode.stop();
  }
  assert.equal(summary.n_views, N_VIEWS - 1);
  assert.ok(summary.objects.n_objects > 3);
  await openedFile(report, async (page) => {
    const rowsUnder = (heading) => page.locator(`h2:text-is("${heading}") ~ div`).first().locator("tbody tr");
    const column = (heading, at) => rowsUnder(heading).evaluateAll((rows, k) => rows.map((row) => row.children[k].innerText), at);
    const sum = (numbers) => numbers.reduce((a, b) => a + Number(b), 0);
    assert.equal(await rowsUnder("Cells").count(), summary.n_cells);
    assert.equal(await page.locator("h2:text-is('Map') ~ figure circle").count(), N_VIEWS);
    assert.equal((await column("Views", 0)).length, summary.n_views);
    assert.equal(sum(await column("Views", 1)), summary.n_masks);
    const pictures = await page.locator("figure img").evaluateAll((all) => all.map((image) => image.naturalWidth));
    assert.ok(pictures.length >= N_VIEWS - 1 && pictures.every((width) => width > 100), String(pictures));
    // Things: as many as the summary counts, their Gaussians as well, and with the ids that answers have.
    const ids = await column("Objects", 0);
    assert.equal(new Set(ids).size, summary.objects.n_objects);
    assert.equal(sum(await column("Objects", 3)), summary.objects.n_gaussians);
    for (const { id, evidence } of answers) assert.equal((await column("Objects", 5))[ids.indexOf(id)], evidence.photo);
    const profiles = (await column("Profiles", 0)).map((name, i) => [name, i]);
    const bytes = await column("Profiles", 1);
    assert.deepEqual(Object.fromEntries(profiles.map(([name, i]) => [name, Number(bytes[i])])), summary.shard_bytes);
    const errors = await column("Profiles", 2);
    for (const [name, i] of profiles) {
      const mean = sum(summary.cells.map((cell) => cell.n_gaussians * cell.score_error[name])) / summary.n_gaussians;
      assert.ok(Math.abs(errors[i] - mean) < 1e-3, `${name}: ${errors[i]} ${mean}`);
    }
    const [left] = await rowsUnder("Left out").allInnerTexts();
    assert.ok(left.includes(broken.split("/").pop()) && left.includes(summary.skipped_views[0].reason), left);
  });
  const cellsOf = (of) => JSON.stringify(JSON.parse(readFileSync(join(of, "manifest"), "utf8")).cells);
  const plain = join(room.folder, "plain");
  try {
    run("slag-encoder", [...flags, "--store", plain, "--quiet"]);
  } catch (error) {
    // 3: done, with a photo left out.
    assert.equal(error.status, 3);
  }
  assert.equal(cellsOf(store), cellsOf(plain));
});
