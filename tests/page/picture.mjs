// Takes a picture of the page in Chromium: picture.mjs LINK OUT.png [WIDTHxHEIGHT]

import { launch } from "./browser.mjs";

const [link, out, size = "1280x720"] = process.argv.slice(2);
const [width, height] = size.split("x").map(Number);
const browser = await launch();
try {
  const page = await browser.newPage({ viewport: { width, height }, colorScheme: "dark", reducedMotion: "reduce" });
  page.on("console", (message) => message.type() === "error" && console.error(message.text()));
  page.setDefaultTimeout(60000);
  await page.goto(link);
  // All cells are drawn, and the question in the link is answered.
  await page.waitForFunction(() => document.documentElement.dataset.complete !== undefined);
  if (/[#&]q=/.test(link)) await page.waitForFunction(() => document.documentElement.dataset.answered !== undefined);
  let last = await page.screenshot();
  for (let i = 0; i < 60; i++) {
    await page.waitForTimeout(500);
    const next = await page.screenshot();
    if (next.equals(last)) break;
    last = next;
  }
  await page.screenshot({ path: out });
  console.log(JSON.stringify(await page.evaluate(() => ({ ...document.documentElement.dataset }))));
} finally {
  await browser.close();
}
