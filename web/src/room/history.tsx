/** Questions that were asked about this room before, and the batches about it, each in a list of its own. */

import { useEffect, useState } from "preact/hooks";
import { batchAnswers, listAnswers, listBatches } from "../api/service";
import type { Answer, Batch } from "../api/types";
import { address } from "../route";
import { t } from "../text";
import type { Room } from "./state";

const ANSWERS_PER_PAGE = 50;
/** Pages that are fetched at most: a large batch may fill many. */
const MAX_PAGES = 4;
/** Own questions that are enough to stop fetching. */
const ENOUGH = 10;
/** Questions that are listed at first. */
const ROWS = 8;

interface Asked { questions: Answer[]; batches: Batch[] }

export function History({ room }: { room: Room }) {
  const [{ questions, batches }, setAsked] = useState<Asked>({ questions: [], batches: [] });
  const [rows, setRows] = useState(ROWS);
  const shown = room.answer.value?.id;
  useEffect(() => {
    let current = true;
    loadHistory(room.id).then(
      (asked) => current && setAsked(asked),
      () => undefined,
    );
    return () => {
      current = false;
    };
  }, [shown]);
  return (
    <>
      <section class="history">
        <h3>{t.ask.history}</h3>
        {questions.length === 0 && <p class="small">{t.ask.noHistory}</p>}
        <ul class="lines">
          {questions.slice(0, rows).map((answer) => (
            <li key={answer.id}>
              <button type="button" class="line" aria-current={answer.id === shown ? "true" : undefined} onClick={() => void room.open(answer.id)}>
                <span>{answer.query}</span>
                <span class={`badge ${answer.status}`}>{t.answer.status[answer.status]}</span>
              </button>
            </li>
          ))}
        </ul>
        {questions.length > rows && (
          <button type="button" class="quiet" onClick={() => setRows(questions.length)}>
            {t.more}
          </button>
        )}
      </section>
      {batches.length > 0 && (
        <section class="history">
          <h3>{t.ask.batches}</h3>
          <ul class="lines">
            {batches.map((batch) => (
              <li key={batch.id}>
                <a class="line" href={address(["batches", batch.id])}>
                  <span>{batch.label ?? t.date(batch.created_at)}</span>
                  <span class="figures small">{t.batches.done(batch.done, batch.items)}</span>
                </a>
              </li>
            ))}
          </ul>
        </section>
      )}
    </>
  );
}

/** The API lists answers of batches among the others: they are told apart by asking each batch for its answers of the same time. */
async function loadHistory(scene: string): Promise<Asked> {
  const all = (await listBatches()).batches;
  const questions: Answer[] = [];
  const batches = new Set<Batch>();
  let cursor: string | null | undefined = null;
  for (let pages = 0; pages < MAX_PAGES && questions.length < ENOUGH; pages++) {
    const page = await listAnswers(scene, ANSWERS_PER_PAGE, cursor);
    const times = page.answers.map(({ id }) => timeOf(id));
    const [since, until] = [Math.min(...times), Math.max(...times)];
    const ofBatches = new Set<string>();
    for (const batch of all.filter((batch) => ranDuring(batch, since, until))) {
      const { answers } = await batchAnswers(scene, batch.id, new Date(since - 1000), new Date(until + 1000));
      if (answers.length) batches.add(batch);
      answers.forEach(({ id }) => ofBatches.add(id));
    }
    questions.push(...page.answers.filter(({ id }) => !ofBatches.has(id)));
    cursor = page.next_cursor;
    if (!cursor) break;
  }
  return { questions: questions.filter(isLatest), batches: [...batches] };
}

/** A question that was asked several times is listed once, with its latest answer. */
const isLatest = (answer: Answer, i: number, all: Answer[]) => all.findIndex(({ query }) => query === answer.query) === i;

/** When an answer was given: its id is a UUIDv7, which starts with the milliseconds. */
const timeOf = (id: string) => parseInt(id.replace("-", "").slice(0, 12), 16);

const ranDuring = ({ created_at, finished_at }: Batch, since: number, until: number) =>
  Date.parse(created_at) <= until && (finished_at == null || Date.parse(finished_at) >= since);
