// The file of `encode --report` in Chromium, of a room that slag-lab generates.

import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { closeBrowser, NIGHTLY, openBrowser, openedFile } from "./browser.mjs";
import { generateRoom, run, serve } from "./programs.mjs";

const N_VIEWS = 8;

let room;
before(async () => {
  await openBrowser();
  room = generateRoom(N_VIEWS);
});
after(async () => {
  await closeBrowser();
  room?.close();
});

/** Runs an encode that leaves a photo out, and returns what it prints. */
function encode(flags) {
  try {
    run("slag-encoder", flags);
  } catch (error) {
    // 3: done, with a photo left out.
    assert.equal(error.status, 3);
    return error.stdout.toString();
  }
  throw new Error("no photo was left out");
}

test("slag-encoder encode: --report has the encode in one file; the bytes are those without it", NIGHTLY, async () => {
  const { frames } = JSON.parse(readFileSync(join(room.room, "transforms.json"), "utf8"));
  const broken = frames[N_VIEWS - 1].file_path;
  writeFileSync(join(room.room, broken), "not a photo");
  const flags = ["encode", "--scene", join(room.room, "scene.ply"), "--views", join(room.room, "transforms.json"), "--metric"];
  const [store, report] = ["reported", "report.html"].map((name) => join(room.folder, name));
  const summary = JSON.parse(encode([...flags, "--store", store, "--report", report, "--json", "--quiet"]));
  const service = await serve("slag-encoder", ["serve", "--store", store, "--listen", "127.0.0.1:0"]);
  let answers;
  try {
    answers = (await (await fetch(`${service.url}/v1/query?text=sofa&limit=1000`)).json()).results[0].answers;
  } finally {
    await service.stop();
  }
  assert.equal(summary.n_views, N_VIEWS - 1);
  assert.ok(summary.objects.n_objects > 3);
  await openedFile(report, async (page) => {
    const rowsUnder = (heading) => page.locator(`h2:text-is("${heading}") ~ div`).first().locator("tbody tr");
    const column = (heading, at) => rowsUnder(heading).evaluateAll((rows, k) => rows.map((row) => row.children[k].innerText), at);
    const sum = (numbers) => numbers.reduce((a, b) => a + Number(b), 0);
    assert.equal(await rowsUnder("Cells").count(), summary.n_cells);
    // The map has each camera at its pose, x to the right and y up; the omitted one is the broken photo's.
    const circles = await page.locator("h2:text-is('Map') ~ figure circle").evaluateAll((all) => all.map((c) => ({
      isLeftOut: c.textContent.includes("left out"), x: Number(c.getAttribute("cx")), y: -Number(c.getAttribute("cy")),
    })));
    assert.equal(circles.length, N_VIEWS);
    const poses = frames.map((frame) => ({ isBroken: frame.file_path === broken, x: frame.transform_matrix[0][3], y: frame.transform_matrix[1][3] }));
    const least = (all, axis) => Math.min(...all.map((one) => one[axis]));
    const [px, m] = [circles, poses].map((all) => Math.max(...all.map(({ x }) => x)) - least(all, "x"));
    for (const pose of poses) {
      const off = (c) => Math.hypot(...["x", "y"].map((axis) => ((c[axis] - least(circles, axis)) * m) / px - pose[axis] + least(poses, axis)));
      assert.ok(circles.some((c) => off(c) < 0.02 * m && c.isLeftOut === pose.isBroken), JSON.stringify({ pose, circles }));
    }
    assert.equal((await column("Views", 0)).length, summary.n_views);
    assert.equal(sum(await column("Views", 1)), summary.n_masks);
    const pictures = await page.locator("figure img").evaluateAll((all) => all.map((image) => image.naturalWidth));
    assert.ok(pictures.length >= N_VIEWS - 1 && pictures.every((width) => width > 100), String(pictures));
    // As many objects and Gaussians as in the summary, with the ids of answers.
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
  encode([...flags, "--store", plain, "--quiet"]);
  assert.equal(cellsOf(store), cellsOf(plain));
});
