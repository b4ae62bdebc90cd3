/** One batch: how far it is, and its results as they arrive. */

import { useEffect, useState } from "preact/hooks";
import { asProblem, wasAborted } from "../api/client";
import { download } from "../api/pictures";
import { getBatch, resultsPath, steerBatch } from "../api/service";
import { jsonLines } from "../api/stream";
import type { Answer, Batch, BatchResult, Problem } from "../api/types";
import { address } from "../route";
import { Progress } from "../scenes/job";
import { t } from "../text";
import { place } from "../ui/fields";
import { ProblemNote } from "../ui/problem";

const LOOK_EVERY = 1000;

/** Rows listed at most: a hundred thousand are for files. */
const ROWS = 500;

/** How often rows that arrived are drawn, milliseconds. */
const DRAW_EVERY = 150;

export function BatchPlace({ batch: id }: { batch: string }) {
  const [batch, setBatch] = useState<Batch | null>(null);
  const [results, setResults] = useState<BatchResult[]>([]);
  const [problem, setProblem] = useState<Problem | null>(null);
  const running = batch?.state === "running";

  useEffect(() => {
    const look = () => getBatch(id).then(setBatch, (thrown) => setProblem(asProblem(thrown)));
    void look();
    if (batch && !running) return;
    const looking = setInterval(() => void look(), LOOK_EVERY);
    return () => clearInterval(looking);
  }, [id, running, batch === null]);

  // Once paused the stream ends: it is taken up again where it stopped.
  const state = batch?.state;
  useEffect(() => {
    if (!state) return;
    const stop = new AbortController();
    void collect(id, setResults, stop.signal).catch((thrown) => !wasAborted(thrown) && !stop.signal.aborted && setProblem(asProblem(thrown)));
    return () => stop.abort();
  }, [id, state]);

  useEffect(() => {
    document.title = `${batch?.label ?? t.batches.title} · ${t.title}`;
  }, [batch?.label]);

  if (!batch) return problem ? <ProblemNote problem={problem} /> : <p class="wait">{t.loading}</p>;
  const attempt = (work: Promise<unknown>) => void work.catch((thrown) => setProblem(asProblem(thrown)));
  const steer = (what: "pause" | "resume" | "cancel") => attempt(steerBatch(id, what).then(setBatch));
  const save = (format: "jsonl" | "csv") => attempt(download(resultsPath(id, format), `${batch.label ?? "batch"}.${format}`));
  return (
    <div class="place">
      <p>
        <a href={address(["batches"])}>← {t.batches.list}</a>
      </p>
      <h1>{batch.label ?? t.date(batch.created_at)}</h1>
      {problem && <ProblemNote problem={problem} />}
      <p class="facts">
        <span class={`badge ${batch.state}`}>{t.batches.state[batch.state]}</span>
        {Object.entries(batch.by_status).map(([status, n]) => (
          <span key={status}>
            {n} {statusText(status)}
          </span>
        ))}
        {batch.cost_usd > 0 && <span>{t.why.cost(batch.cost_usd)}</span>}
        {batch.reason && <code>{batch.reason}</code>}
      </p>
      <Progress share={batch.done / Math.max(1, batch.items)} words={t.batches.done(batch.done, batch.items)} eta_s={batch.eta_s ?? null} />
      <div class="buttons">
        {running && (
          <button type="button" onClick={() => steer("pause")}>
            {t.batches.pause}
          </button>
        )}
        {batch.state === "paused" && (
          <button type="button" onClick={() => steer("resume")}>
            {t.batches.resume}
          </button>
        )}
        {(running || batch.state === "paused") && (
          <button type="button" onClick={() => steer("cancel")}>
            {t.batches.stop}
          </button>
        )}
        <button type="button" onClick={() => save("jsonl")}>
          {t.batches.download("JSONL")}
        </button>
        <button type="button" onClick={() => save("csv")}>
          {t.batches.download("CSV")}
        </button>
      </div>
      <Results results={results} items={batch.items} />
    </div>
  );
}

/** Reads results in order, and shows them a few times a second. */
async function collect(id: string, show: (results: BatchResult[]) => void, signal: AbortSignal): Promise<void> {
  const results: BatchResult[] = [];
  let shown = 0;
  for await (const result of jsonLines<BatchResult>(resultsPath(id, "jsonl", true), signal)) {
    results.push(result);
    if (results.length >= ROWS) break;
    if (performance.now() - shown < DRAW_EVERY) continue;
    shown = performance.now();
    show([...results]);
  }
  if (!signal.aborted) show(results);
}

function Results({ results, items }: { results: BatchResult[]; items: number }) {
  const { columns } = t.batches;
  return (
    <section>
      <h2>{t.batches.results}</h2>
      <div class="scroll" tabIndex={0} role="region" aria-label={t.batches.results}>
        <table class="results">
          <thead>
            <tr>
              {Object.entries(columns).map(([name, column]) => (
                <th scope="col" key={name} class={name === "item" || name === "confidence" ? "right" : ""}>
                  {column}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {results.map((result) => (
              <ResultRow key={result.item} result={result} />
            ))}
          </tbody>
        </table>
      </div>
      {results.length >= ROWS && <p class="small">{t.batches.shown(results.length, items)}</p>}
    </section>
  );
}

function ResultRow({ result }: { result: BatchResult }) {
  const answer = result.answer as Answer | null | undefined;
  return (
    <tr>
      <td class="right figures">{result.item + 1}</td>
      <td>{answer ? <a href={address(["scenes", result.scene_id], { answer: result.answer_id })}>{result.query}</a> : result.query}</td>
      <td>
        <span class={`badge ${result.status}`}>{statusText(result.status)}</span>
      </td>
      <td>{result.error ? result.error.detail : answer ? chosen(answer) : ""}</td>
      <td class="right figures">{answer ? answer.confidence.toFixed(2) : ""}</td>
      <td class="figures">{answer?.box ? place(answer.box.center) : ""}</td>
    </tr>
  );
}

function chosen({ count, targets, answer: { predicted_id: id, candidate_names: names } }: Answer): string {
  if (id == null) return "";
  const name = targets?.find((target) => target.id === id)?.name ?? names[id] ?? "";
  return count == null ? `${name} ${id}` : t.answer.counted(count, name);
}

const statusText = (status: string) => (t.answer.status as Record<string, string>)[status] ?? status;
