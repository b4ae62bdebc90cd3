/** A picture of the service's, shown also where a key is wanted; those that hold much can be enlarged. */

import { useEffect, useRef, useState } from "preact/hooks";
import { borrowPicture, returnPicture } from "../api/pictures";
import { t } from "../text";
import { Dialog } from "./dialog";

interface Properties { path: string; alt: string; class?: string; enlarge?: boolean }

export function Picture({ path, alt, class: kind = "", enlarge }: Properties) {
  const [address, setAddress] = useState<string | null>(null);
  const [missing, setMissing] = useState(false);
  const [near, setNear] = useState(false);
  const [large, setLarge] = useState(false);
  const place = useRef<HTMLSpanElement>(null);

  // Only what is about to be seen is fetched.
  useEffect(() => {
    const watching = new IntersectionObserver(
      (entries) => entries.some((entry) => entry.isIntersecting) && setNear(true),
      { rootMargin: "300px" },
    );
    watching.observe(place.current!);
    return () => watching.disconnect();
  }, []);

  useEffect(() => {
    if (!near) return;
    let current = true;
    setMissing(false);
    borrowPicture(path).then(
      (url) => current && setAddress(url),
      () => current && setMissing(true),
    );
    return () => {
      current = false;
      returnPicture(path);
    };
  }, [path, near]);

  return (
    <span class={`picture ${kind}`} ref={place}>
      {address && !missing && !enlarge && <img src={address} alt={alt} />}
      {address && !missing && enlarge && (
        <button type="button" class="enlarge" aria-label={t.enlarge(alt)} onClick={() => setLarge(true)}>
          <img src={address} alt={alt} />
        </button>
      )}
      {address && large && (
        <Dialog title={alt} wide onClose={() => setLarge(false)}>
          <img src={address} alt={alt} />
        </Dialog>
      )}
      {missing && <span class="missing">{t.pictureMissing}</span>}
    </span>
  );
}
