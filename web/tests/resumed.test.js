// A scan whose way to the service breaks off: what was sent stays sent.

import assert from "node:assert/strict";
import { readFileSync, statSync } from "node:fs";
import { after, before, test } from "node:test";
import { openPage, startBrowser } from "./support/browser.js";
import { SAMPLE, startService } from "./support/service.js";

const SIZE = statSync(SAMPLE).size;
const HALF = SIZE >> 1;

let service, browser;
before(async () => {
  service = await startService();
  browser = await startBrowser();
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

/** Lets half of the first part through, and then nothing more until `mend`: as a network that goes away. */
async function breakHalfway(page) {
  const state = { offsets: [], broken: true };
  await page.route("**/v1/uploads/*", async (route) => {
    const request = route.request();
    if (request.method() !== "PATCH") return state.broken && state.offsets.length ? route.abort("connectionreset") : route.continue();
    const offset = Number(request.headers()["upload-offset"]);
    state.offsets.push(offset);
    if (!state.broken) return route.continue();
    if (offset === 0) {
      const headers = { "tus-resumable": "1.0.0", "upload-offset": "0", "content-type": "application/offset+octet-stream" };
      const sent = await fetch(request.url(), { method: "PATCH", headers, body: readFileSync(SAMPLE).subarray(0, HALF) });
      assert.equal(sent.status, 204);
    }
    return route.abort("connectionreset");
  });
  return { state, mend: () => (state.broken = false) };
}

const scenes = () => fetch(`${service.api}/v1/scenes`).then((reply) => reply.json()).then(({ scenes }) => scenes.length);

/** Until the scan can be looked at, and is one scene more than there were. */
async function arrived(page, before) {
  await page.getByRole("link", { name: "Open the room" }).waitFor({ timeout: 60_000 });
  assert.equal(await scenes(), before + 1);
}

test("an upload goes on by itself when the network is back", async () => {
  const { page, complaints, close } = await openPage(browser, service.page);
  const [{ state, mend }, before] = [await breakHalfway(page), await scenes()];
  await page.setInputFiles("input[type=file]", SAMPLE);
  while (state.offsets.length < 1) await page.waitForTimeout(20);
  await page.waitForTimeout(500);
  mend();
  await arrived(page, before);
  assert.deepEqual(state.offsets, [0, HALF]);
  assert.deepEqual(complaints, []);
  await close();
});

test("the same file goes on where it was after a reload, and begins anew when that is done", async () => {
  const { page, close } = await openPage(browser, service.page);
  const [{ state, mend }, before] = [await breakHalfway(page), await scenes()];
  await page.setInputFiles("input[type=file]", SAMPLE);
  while (state.offsets.length < 1) await page.waitForTimeout(20);
  await page.reload();
  mend();
  await page.setInputFiles("input[type=file]", SAMPLE);
  await arrived(page, before);
  assert.deepEqual(state.offsets, [0, HALF]);
  assert.equal(await page.evaluate(() => Object.keys({ ...localStorage }).filter((key) => key.startsWith("tus::")).length), 0);
  await page.getByRole("button", { name: "Dismiss" }).click();
  await page.setInputFiles("input[type=file]", SAMPLE);
  await arrived(page, before + 1);
  assert.deepEqual(state.offsets, [0, HALF, 0], "an upload that is done is not gone on with");
  await close();
});
