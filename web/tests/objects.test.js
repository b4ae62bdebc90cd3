// The list of objects: its order, its colors, its search.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { openPage, startBrowser } from "./support/browser.js";
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

const open = () => openPage(browser, `${service.page}/#/scenes/${scene.id}?tab=things`);

test("objects come first, the building last, each with its colors", async () => {
  const { page, complaints, close } = await open();
  const rows = page.locator(".panel .line");
  await rows.first().waitFor();
  const names = await rows.locator(".number + span").allTextContents();
  const building = names.map((name) => /^(floor|wall|ceiling)/.test(name));
  assert.equal(building[0], false, names[0]);
  assert.ok(building.lastIndexOf(false) < building.indexOf(true), names.join(" | "));
  await page.getByRole("heading", { name: "Walls, floor and ceiling" }).waitFor();
  assert.ok((await rows.first().locator(".color").count()) > 0);
  assert.deepEqual(complaints, []);
  await close();
});

test("the search finds what is listed and what answers name, in the plural too", async () => {
  const { page, complaints, close } = await open();
  const rows = page.locator(".panel .line");
  await rows.first().waitFor();
  for (const [words, name] of [["mugs", /mug/], ["the red sofa", /sofa/], ["walls", /wall/], ["building", /wall|floor|ceiling/], ["gray", /./]]) {
    await page.getByLabel("Search names").fill(words);
    await page.waitForTimeout(100);
    assert.ok((await rows.count()) > 0, words);
    assert.match(await rows.first().textContent(), name);
  }
  // Parts and groups are found among objects, in a list of their own.
  const { instances } = await (await fetch(`${service.api}/v1/scenes/${scene.id}/instances?limit=1000&level=parts`)).json();
  await page.getByLabel("Search names").fill(String(instances[0].id));
  await page.getByRole("heading", { name: "Parts and groups" }).waitFor();
  await page.getByLabel("Search names").fill("zorgly");
  await page.getByText("Nothing found. Try another word.").waitFor();
  assert.deepEqual(complaints, []);
  await close();
});
