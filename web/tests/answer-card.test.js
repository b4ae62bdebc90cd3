// What an answer shows: the photograph, and the closest candidates where nothing fits.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { drawn, openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

let service, browser, scene;
before(async () => {
  service = await startService();
  browser = await startBrowser();
  scene = await parsedSample(service.api);
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

const room = (query = "") => openPage(browser, `${service.page}/#/scenes/${scene.id}${query}`);

async function ask(page, question) {
  await page.getByLabel("Question").fill(question);
  await page.keyboard.press("Enter");
  const answer = page.getByRole("article", { name: "Answer" });
  await answer.waitFor();
  return answer;
}

test("the answer shows the photograph in which the object is marked, and it can be enlarged", async () => {
  const { page, complaints, close } = await room();
  const [picture] = await Promise.all([
    page.waitForResponse(/\/instances\/\d+\/views\/0\.jpg\?picture=frame$/),
    ask(page, "the mug on the coffee table"),
  ]);
  assert.equal(picture.headers()["content-type"], "image/jpeg");
  const marked = page.getByRole("button", { name: /^Enlarge: .*mug, marked in photo \d+/ });
  await marked.click();
  await page.getByRole("dialog").locator("img").waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

/** Waits until the camera stands and the address says where: a busy machine flies slowly. */
async function still(page) {
  const place = async () => `${await page.evaluate(() => window.unigroundPage.camera().position)} ${page.url()}`;
  for (let [before, now] = ["", await place()]; before !== now; [before, now] = [now, await place()]) {
    await page.waitForTimeout(800);
  }
}

test("no match is said once, with the closest candidates, and the camera stays", async () => {
  const { page, complaints, close } = await room();
  await drawn(page);
  await page.locator("canvas").press("ArrowLeft");
  await still(page);
  const [before, address] = [await page.evaluate(() => window.unigroundPage.camera().position), page.url()];
  const answer = await ask(page, "the purple beds");
  await still(page);
  assert.deepEqual(await page.evaluate(() => window.unigroundPage.camera().position), before);
  assert.equal(new URL(page.url()).hash.match(/cam=[^&]*/)[0], new URL(address).hash.match(/cam=[^&]*/)[0]);
  assert.equal((await answer.innerText()).match(/found no|nothing/gi).length, 1);
  assert.equal(await answer.locator(".line").count(), 3);
  assert.deepEqual(complaints, []);
  await close();
});
