/** Lists of questions: a new one, and all there were. */

import { useEffect, useState } from "preact/hooks";
import { listBatches } from "../api/service";
import type { Batch } from "../api/types";
import { address } from "../route";
import { t } from "../text";
import { useLoaded } from "../ui/load";
import { ProblemNote } from "../ui/problem";
import { NewBatch } from "./new";

export function BatchesPlace() {
  const { value, problem, again } = useLoaded(() => listBatches(), []);
  const [further, setFurther] = useState<{ batches: Batch[]; next: string | null } | null>(null);
  useEffect(() => {
    document.title = `${t.batches.title} · ${t.title}`;
  }, []);
  const batches = [...(value?.batches ?? []), ...(further?.batches ?? [])];
  const next = further ? further.next : (value?.next_cursor ?? null);
  const more = async () => {
    const page = await listBatches(next);
    setFurther({ batches: [...(further?.batches ?? []), ...page.batches], next: page.next_cursor ?? null });
  };
  return (
    <div class="place">
      <h1>{t.batches.title}</h1>
      <p>{t.batches.what}</p>
      <NewBatch />
      <h2>{t.batches.list}</h2>
      {problem && <ProblemNote problem={problem} onAgain={again} />}
      {value && batches.length === 0 && <p class="empty">{t.batches.empty}</p>}
      <ul class="lines wide">
        {batches.map((batch) => (
          <li key={batch.id}>
            <a class="line" href={address(["batches", batch.id])}>
              <span>{batch.label ?? t.date(batch.created_at)}</span>
              <span class={`badge ${batch.state}`}>{t.batches.state[batch.state]}</span>
              <span class="figures small">{t.batches.done(batch.done, batch.items)}</span>
            </a>
          </li>
        ))}
      </ul>
      {next && (
        <button type="button" onClick={() => void more()}>
          {t.more}
        </button>
      )}
    </div>
  );
}
