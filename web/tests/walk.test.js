// Walk mode: where it starts, how it is left.

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

test("walk mode faces the selected object, says its keys, and Escape leaves it", async () => {
  const { page, complaints, close } = await room("?tab=things");
  await drawn(page);
  await page.locator(".panel .line").nth(2).click();
  await page.locator("[data-instance]").waitFor();
  await page.getByRole("button", { name: "Walk", exact: true }).click();
  await page.getByText(/W A S D or arrow keys/).first().waitFor();
  await drawn(page);
  const [{ box }] = await page.evaluate(() => window.unigroundPage.boxes().filter(({ role }) => role === "selected"));
  const [at, canvas] = [await page.evaluate((point) => window.unigroundPage.project(point), box.center), await page.locator("canvas").boundingBox()];
  assert.ok(Math.abs(at.x - (canvas.x + canvas.width / 2)) < 5 && Math.abs(at.y - (canvas.y + canvas.height / 2)) < 5, JSON.stringify(at));
  const before = await page.evaluate(() => window.unigroundPage.camera().position);
  await page.keyboard.press("w");
  await page.waitForTimeout(300);
  const after = await page.evaluate(() => window.unigroundPage.camera().position);
  const away = (from) => Math.hypot(from[0] - box.center[0], from[1] - box.center[1]);
  assert.ok(away(after) < away(before), "W walks towards what is looked at");
  await page.getByRole("heading", { name: /object \d+/ }).click();
  await page.keyboard.press("Escape");
  assert.equal(await page.getByRole("button", { name: "Walk", exact: true }).getAttribute("aria-pressed"), "false");
  assert.deepEqual(complaints, []);
  await close();
});
