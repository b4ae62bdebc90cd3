// How the room feels with many points: bytes and seconds to the first picture, seconds to all, milliseconds a frame while it turns.
//
//   node tests/large-cloud.js [POINTS]      (default 5,000,000; the sample scan's points, again and again, a little apart)
//
// It says how this machine is: in software rendering little about machines with a graphics card. It fails where the first picture
// takes more than FIRST_BYTES or FIRST_MS.

import { front } from "./support/front.js";
import { startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

const wanted = Number(process.argv[2] ?? 5_000_000);
const FIRST_BYTES = 3e6;
const FIRST_MS = 2000;
const service = await startService();
const scene = await parsedSample(service.api);
const points = grow(Buffer.from(await (await fetch(`${service.api}/v1/scenes/${scene.id}/points.bin`)).arrayBuffer()));
const before = await front(service.api, (path) => (path.endsWith("/points.bin") ? points : null));
const browser = await startBrowser();
const page = await (await browser.newContext({ viewport: { width: 1280, height: 800 } })).newPage();
await page.addInitScript(() => performance.setResourceTimingBufferSize(2000));
await page.goto(`${before.address}/#/scenes/${scene.id}`);
await page.waitForFunction(() => window.unigroundPage?.loaded().all > 0, null, { timeout: 60_000 });
await page.waitForFunction(() => window.unigroundPage.loaded().points === window.unigroundPage.loaded().all, null, { timeout: 300_000 });
// As the browser has measured it: all that was asked for before the first picture, even where it came later.
const first = await page.evaluate(() => {
  const [{ startTime: at_ms }] = performance.getEntriesByName("first picture");
  const asked = [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")];
  const bytes = (some) => some.reduce((sum, { transferSize }) => sum + transferSize, 0);
  return { at_ms, all_ms: performance.now(), bytes: bytes(asked.filter(({ startTime }) => startTime < at_ms)), all_bytes: bytes(asked) };
});
console.log(`first picture: ${(first.at_ms / 1000).toFixed(1)} s, ${(first.bytes / 1e6).toFixed(2)} MB`);
const all = `all ${wanted.toLocaleString("en")} points, and whose they are`;
console.log(`${all}: ${(first.all_ms / 1000).toFixed(1)} s, ${(first.all_bytes / 1e6).toFixed(1)} MB`);
await page.waitForTimeout(3000);
await page.locator("canvas").focus();
const turned = await page.evaluate(async () => {
  const canvas = document.querySelector("canvas");
  const end = performance.now() + 6000;
  let shown = 0;
  while (performance.now() < end) {
    canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" }));
    await new Promise((resolve) => requestAnimationFrame(resolve));
    shown = window.unigroundPage.shown();
  }
  return { shown, frame_ms: window.unigroundPage.camera().frame_ms };
});
console.log(`turning: ${turned.frame_ms.toFixed(0)} ms a frame, of ${turned.shown.toLocaleString("en")} points`);
await browser.close();
before.close();
await service.stop();

if (first.bytes >= FIRST_BYTES || first.at_ms >= FIRST_MS) {
  console.error(`the first picture is to come before ${FIRST_BYTES / 1e6} MB and ${FIRST_MS} ms`);
  process.exitCode = 1;
}

/** The same points again and again, each time a few steps aside. */
function grow(bytes) {
  const [head, stride] = [32, 12];
  const count = bytes.readUInt32LE(4);
  const all = Buffer.alloc(head + wanted * stride);
  bytes.copy(all, 0, 0, head);
  all.writeUInt32LE(wanted, 4);
  const steps = 0.004 / bytes.readFloatLE(28);
  for (let i = 0; i < wanted; i++) {
    const to = head + i * stride;
    const from = head + (i % count) * stride;
    bytes.copy(all, to, from, from + stride);
    const turn = Math.floor(i / count);
    for (const axis of [0, 2, 4]) {
      const aside = all.readUInt16LE(to + axis) + Math.round(steps * (((turn * 7 + axis) % 5) - 2));
      all.writeUInt16LE(Math.min(65535, Math.max(0, aside)), to + axis);
    }
  }
  return all;
}
