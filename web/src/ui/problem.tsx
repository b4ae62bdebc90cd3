/** What went wrong: title, detail, what to do. Never a bare code. */

import type { JobError, Problem } from "../api/types";
import { t } from "../text";

export function ProblemNote({ problem, onAgain }: { problem: Problem; onAgain?: () => void }) {
  return (
    <div class="problem" role="alert">
      <h3>{titleOf(problem)}</h3>
      <p>{problem.detail}</p>
      {problem.errors?.map(({ pointer, detail }) => (
        <p key={pointer}>
          <code>{pointer}</code> {detail}
        </p>
      ))}
      <p class="todo">
        <b>{t.problem.todo}:</b> {t.problem.advice[problem.code] ?? t.problem.otherwise}
      </p>
      <p class="small">
        {problem.status > 0 && `${problem.status} ${problem.title} · `}
        {t.problem.code} <code>{problem.code}</code>
        {problem.request_id && (
          <>
            {" "}
            · {t.problem.request} <code>{problem.request_id}</code>
          </>
        )}
      </p>
      {onAgain && (
        <button type="button" onClick={onAgain}>
          {t.problem.again}
        </button>
      )}
    </div>
  );
}

/** The service's own titles are those of HTTP: its codes say more. */
function titleOf({ code, title }: Problem): string {
  if (/^http_\d+$/.test(code)) return title;
  const words = code.replace(/_/g, " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** A job's or item's failure, in the same form. */
export function ofJob(error: JobError, title: string): Problem {
  return { type: "about:blank", title, status: 0, detail: error.detail, code: error.code };
}
