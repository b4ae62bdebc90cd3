// How the room feels with many points: bytes and seconds to the first picture, seconds to all, milliseconds a frame while it turns.
//
//   node tests/large-cloud.js [POINTS]      (default 5,000,000; the sample scan's points, again and again, a little apart)
//
// No test: it says how this machine is. In software rendering it says little about machines with a graphics card.

import { front } from "./support/front.js";
import { startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

const wanted = Number(process.argv[2] ?? 5_000_000);
const service = await startService();
const scene = await parsedSample(service.api);
const grown = {};
for (const [file, stride] of [["cloud.ply", 15], ["instances.ply", 19]]) {
  const bytes = Buffer.from(await (await fetch(`${service.api}/v1/scenes/${scene.id}/${file}`)).arrayBuffer());
  grown[file] = grow(bytes, stride);
}
const before = await front(service.api, (path) => grown[path.split("/").at(-1)] ?? null);
const browser = await startBrowser();
const page = await (await browser.newContext({ viewport: { width: 1280, height: 800 } })).newPage();
let received = 0;
const session = await page.context().newCDPSession(page);
await session.send("Network.enable");
session.on("Network.dataReceived", ({ dataLength }) => (received += dataLength));
const start = performance.now();
const since = () => `${((performance.now() - start) / 1000).toFixed(1)} s`;
await page.goto(`${before.address}/#/scenes/${scene.id}`);
await page.waitForFunction(() => window.unigroundPage?.shown() > 0, null, { polling: 20 });
console.log(`first picture: ${since()}, ${(received / 1e6).toFixed(1)} MB`);
await page.waitForFunction(() => window.unigroundPage.loaded().points > 0, null, { timeout: 300_000 });
console.log(`all ${wanted.toLocaleString("en")} points: ${since()}, ${(received / 1e6).toFixed(1)} MB`);
await page.waitForFunction(() => window.unigroundPage.loaded().instances, null, { timeout: 300_000 });
console.log(`and whose they are: ${since()}, ${(received / 1e6).toFixed(1)} MB`);
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

function grow(bytes, stride) {
  const head = bytes.indexOf("end_header\n") + 11;
  const count = (bytes.length - head) / stride;
  const header = Buffer.from(bytes.toString("latin1", 0, head).replace(`vertex ${count}`, `vertex ${wanted}`), "latin1");
  const all = Buffer.alloc(header.length + wanted * stride);
  header.copy(all);
  for (let i = 0; i < wanted; i++) {
    const to = header.length + i * stride;
    bytes.copy(all, to, head + (i % count) * stride, head + ((i % count) + 1) * stride);
    const turn = Math.floor(i / count);
    for (const axis of [0, 4, 8]) all.writeFloatLE(all.readFloatLE(to + axis) + 0.004 * (((turn * 7 + axis) % 5) - 2), to + axis);
  }
  return all;
}
