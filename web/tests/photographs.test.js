// Where the room was photographed, and what is seen from there.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { drawn, keep, openPage, startBrowser } from "./support/browser.js";
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

const open = (query = "") => openPage(browser, `${service.page}/#/scenes/${scene.id}${query}`);

test("a camera in the picture opens its photograph, and the next one is a key away", async () => {
  const { page, complaints, close } = await open();
  await drawn(page);
  assert.deepEqual(await page.evaluate(() => window.unigroundPage.frames()), []);
  await page.getByRole("button", { name: "Cameras" }).click();
  await page.waitForFunction(() => window.unigroundPage.frames().length > 0);
  await page.waitForTimeout(300);
  const frames = await page.evaluate(() => window.unigroundPage.frames().map((one) => ({ ...one, at: window.unigroundPage.project(one.position) })));
  assert.equal(frames.length, 30);
  await page.mouse.move(frames[4].at.x, frames[4].at.y);
  await page.locator("canvas[data-over=true]").waitFor();
  await keep(page, "cameras");
  const [picture] = await Promise.all([
    page.waitForResponse(/\/photograph\.jpg\?instances=true$/),
    page.mouse.click(frames[4].at.x, frames[4].at.y),
  ]);
  assert.equal(picture.headers()["content-type"], "image/jpeg");
  const dialog = page.getByRole("dialog");
  await dialog.locator("img").waitFor();
  await page.waitForTimeout(300);
  await keep(page, "photograph");
  const title = dialog.getByRole("heading");
  const first = Number(/^Photo (\d+)$/.exec(await title.textContent())[1]);
  await dialog.getByRole("button", { name: "Next" }).focus();
  await page.keyboard.press("ArrowRight");
  assert.equal(await title.textContent(), `Photo ${first + 1}`);
  await dialog.getByRole("button", { name: "Previous" }).click();
  assert.equal(await title.textContent(), `Photo ${first}`);
  await page.keyboard.press("Escape");
  await dialog.waitFor({ state: "detached" });
  assert.deepEqual(complaints, []);
  await close();
});

test("the list of photographs does the same by keyboard", async () => {
  const { page, complaints, close } = await open("?tab=photos");
  await page.getByText("30 photographs").waitFor();
  await page.getByRole("button", { name: "Photo 0" }).focus();
  await page.keyboard.press("Enter");
  const dialog = page.getByRole("dialog");
  await dialog.locator("img").waitFor();
  assert.equal(await dialog.getByRole("button", { name: "Previous" }).isDisabled(), true);
  await page.getByText("1 of 30").waitFor();
  assert.deepEqual(complaints, []);
  await close();
});
