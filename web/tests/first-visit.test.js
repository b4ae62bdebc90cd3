// Somebody opens the printed address for the first time, with a scan in hand.

import assert from "node:assert/strict";
import { mkdtempSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { drawn, keep, openPage, startBrowser } from "./support/browser.js";
import { SAMPLE, startService } from "./support/service.js";

let service, browser;
before(async () => {
  service = await startService({ empty: true });
  browser = await startBrowser();
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

test("from the first visit to an answered question in fewer than five actions", async () => {
  const { page, complaints, close } = await openPage(browser, service.page);
  await page.getByText("No scenes yet.").waitFor();
  const seen = await watchProgress(page);
  let actions = 0;
  const act = async (doing) => {
    actions += 1;
    await doing;
  };
  await act(page.setInputFiles("input[type=file]", SAMPLE));
  await act(page.getByRole("link", { name: "Open the room" }).click({ timeout: 60_000 }));
  await act(page.getByLabel("Question").fill("the mug on the coffee table"));
  await act(page.keyboard.press("Enter"));
  const answer = page.getByRole("article", { name: "Answer" });
  await answer.getByText("found", { exact: true }).waitFor();
  assert.match(await answer.textContent(), /mug/);
  assert.ok(actions < 5, `${actions} actions`);

  await keep(page, "first-visit");
  const words = await seen();
  assert.ok(words.some((text) => /^(Sending|Unpacking)/.test(text)), words.join(" | "));
  assert.ok(words.some((text) => /Reading frames|Finding|Cutting|Joining|Measuring/.test(text)), words.join(" | "));
  assert.ok(words.every((text) => / · \d+ %/.test(text)), words.join(" | "));
  await drawn(page);
  assert.deepEqual(complaints, []);
  await close();
});

test("the sample scene is one click away, and its picture is in the list when it is parsed", async (test) => {
  const other = await startService({ empty: true });
  test.after(() => other.stop());
  const { page, complaints, close } = await openPage(browser, other.page);
  await page.getByRole("button", { name: "Open the sample scene" }).click();
  const card = page.locator(".card");
  await card.waitFor();
  // An empty frame stands where the picture will be.
  const size = () => card.locator(".thumb .picture").evaluate(({ clientWidth, clientHeight }) => [clientWidth, clientHeight]);
  const empty = await size();
  await page.getByRole("link", { name: "Open the room" }).waitFor({ timeout: 60_000 });
  await card.locator("img").waitFor();
  assert.deepEqual(await size(), empty);
  await keep(page, "sample");
  await page.getByRole("link", { name: "Open the room" }).click();
  await drawn(page);
  assert.deepEqual(complaints, []);
  await close();
});

test("what can not be read is told with what to do, and the next try is one press away", async () => {
  const { page, complaints, close } = await openPage(browser, service.page);
  const folder = mkdtempSync(join(tmpdir(), "uniground-bad-"));
  const broken = join(folder, "broken.zip");
  writeFileSync(broken, "this is no archive");
  await page.setInputFiles("input[type=file]", broken);
  const problem = page.getByRole("alert").first();
  await problem.waitFor();
  assert.match(await problem.textContent(), /What to do:.*archive_unreadable/s);
  await keep(page, "refused");
  await page.getByRole("button", { name: "Try another file" }).click();

  const wrong = join(folder, "holiday.mp4");
  writeFileSync(wrong, Buffer.from("\0\0\0\x18ftypmp42", "latin1"));
  await page.setInputFiles("input[type=file]", wrong);
  await page.getByText("this is a video").waitFor();
  await page.getByRole("button", { name: "Try another file" }).click();
  await page.getByRole("button", { name: "choose a file" }).waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

test("a scene that is not there is told as such", async () => {
  const { page, close } = await openPage(browser, `${service.page}/#/scenes/01a20629-937f-7635-ba7b-8cc789268a60`);
  await page.getByText("scene_not_found").waitFor();
  await close();
});

test("a scene can be renamed and deleted", async () => {
  const { page, complaints, close } = await openPage(browser, service.page);
  await page.getByRole("button", { name: "Rename" }).first().click();
  await page.getByLabel("New name").fill("the room downstairs");
  await page.keyboard.press("Enter");
  await page.getByRole("link", { name: "the room downstairs" }).waitFor();
  page.on("dialog", (dialog) => dialog.accept());
  await page.getByRole("button", { name: "Delete" }).first().click();
  await page.getByText("No scenes yet.").waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

/** Collects every line of progress that is shown. */
async function watchProgress(page) {
  await page.evaluate(() => {
    window.progressSeen = new Set();
    const look = () => document.querySelectorAll(".progress span").forEach((line) => window.progressSeen.add(line.textContent.trim()));
    new MutationObserver(look).observe(document.body, { childList: true, subtree: true, characterData: true });
  });
  return () => page.evaluate(() => [...window.progressSeen].filter(Boolean));
}
