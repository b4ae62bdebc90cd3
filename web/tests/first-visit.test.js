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
  await page.getByRole("button", { name: "Open the sample room" }).waitFor();
  // A server without keys offers none.
  assert.equal(await page.getByRole("button", { name: "Key" }).count(), 0);
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
  await answer.getByText("uncertain", { exact: true }).waitFor();
  assert.match(await answer.textContent(), /mug/);
  assert.ok(actions < 5, `${actions} actions`);

  await keep(page, "first-visit");
  const words = await seen();
  assert.ok(words.some((text) => /^(Uploading|Unpacking)/.test(text)), words.join(" | "));
  assert.ok(words.some((text) => /Reading the scan|Building|Finding|Grouping|Joining|Measuring/.test(text)), words.join(" | "));
  assert.ok(words.every((text) => / · \d+ %/.test(text)), words.join(" | "));
  await drawn(page);
  assert.deepEqual(complaints, []);
  await close();
});

test("the sample room is one click away, and is entered while it is parsed", async (test) => {
  const other = await startService({ empty: true });
  test.after(() => other.stop());
  const { page, complaints, close } = await openPage(browser, other.page);
  await page.getByRole("note", { name: "Models in use" }).getByText(/no neural models/).waitFor();
  await page.getByRole("button", { name: "Get better answers" }).click();
  await page.getByRole("dialog").getByText("uniground serve --fetch-models").waitFor();
  await page.keyboard.press("Escape");
  await keep(page, "welcome");
  await page.getByRole("button", { name: "Open the sample room" }).click();
  await page.getByText(/It appears here as soon as it is done/).waitFor();
  await page.getByText("Find objects in the photos").waitFor();
  // A question that is asked meanwhile is answered when the room is there.
  await page.getByRole("button", { name: "the orange stool" }).click();
  await page.getByText(/“the orange stool” is asked as soon as/).waitFor();
  // The scan can be looked at meanwhile, unless the parse is faster than the browser.
  await page.locator('[data-draft="true"]').or(page.getByRole("article", { name: "Answer" })).first().waitFor();
  await keep(page, "waiting");
  await page.getByRole("article", { name: "Answer" }).getByText("orange stool").first().waitFor({ timeout: 90_000 });
  await drawn(page);
  assert.deepEqual(complaints, []);
  await close();
});

test("an example on the first page opens the sample with that question", async (test) => {
  const other = await startService({ empty: true });
  test.after(() => other.stop());
  const { page, complaints, close } = await openPage(browser, other.page);
  await page.getByRole("button", { name: "the mug on the coffee table" }).click();
  const answer = page.getByRole("article", { name: "Answer" });
  await answer.getByText("uncertain", { exact: true }).waitFor({ timeout: 90_000 });
  assert.match(await answer.textContent(), /mug/);
  assert.deepEqual(complaints, []);
  await close();
});

test("a scan that was uploaded has its picture in the list when it is parsed", async (test) => {
  const other = await startService({ empty: true });
  test.after(() => other.stop());
  const { page, complaints, close } = await openPage(browser, other.page);
  await page.setInputFiles("input[type=file]", SAMPLE);
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
  await page.getByRole("button", { name: "Open the sample room" }).waitFor();
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
