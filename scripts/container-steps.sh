#!/usr/bin/env bash
# Runs the Dockerfile's steps without a container engine: a clean context, every COPY and RUN as written, then the result.
#
#   container-steps.sh [--dry-run] [--keep] [REVISION]      default: HEAD. --dry-run parses and prints, copies and runs nothing
#
# The context is `git archive REVISION` without the files in .dockerignore. Every stage is a folder that stands for its root:
# WORKDIR and COPY go below it, RUN runs there with this machine's programs. So a RUN with an absolute path is refused, and one that
# begins with apt-get is skipped (and named): it would change this machine. What only an engine can do is named as well: the base
# images, USER, VOLUME and the like. At the end: --version, ONNX Runtime found next to the binary, the HEALTHCHECK against the running service.
set -euo pipefail
cd "$(dirname "$0")/.."

dry_run='' keep='' revision=HEAD
while [ $# -gt 0 ]; do
    case $1 in
        --dry-run) dry_run=1 ;;
        --keep) keep=1 ;;
        -h | --help) sed -n '2,9p' "$0"; exit 0 ;;
        -*) echo "container-steps: unknown option $1" >&2; exit 2 ;;
        *) revision=$1 ;;
    esac
    shift
done

die() { printf 'container-steps: %s\n' "$*" >&2; exit 1; }
say() { printf '%s\n' "$*"; }

work=$(mktemp -d)
server=''
# shellcheck disable=SC2329 # called by the trap
clean_up() {
    [ -z "$server" ] || { kill "$server" && wait "$server"; } 2>/dev/null || true
    if [ -n "$keep" ]; then say "kept: $work"; else rm -rf "$work"; fi
}
trap clean_up EXIT
all=$work/all context=$work/context
mkdir "$all" "$context"
git archive "$revision" | tar -x -C "$all"

# kept PATH: whether .dockerignore lets it through. The last pattern that fits the path, or a folder it lies in, decides.
# Only patterns for which it makes no difference that a * here also stands for slashes.
kept() {
    local pattern answer=0
    while IFS= read -r pattern; do
        case $pattern in '' | '#'*) continue ;; esac
        local here=1
        case $pattern in '!'*) here=0 pattern=${pattern#!} ;; esac
        pattern=${pattern#/}
        # shellcheck disable=SC2053 # a pattern
        if [[ $1 == $pattern || $1 == $pattern/* ]]; then answer=$here; fi
    done <"$all/.dockerignore"
    return "$answer"
}
(cd "$all" && find . -type f -o -type l) | sed 's|^\./||' | sort >"$work/files"
while IFS= read -r file; do
    if kept "$file"; then say "$file"; fi
done <"$work/files" >"$work/kept"
tar -c -C "$all" -T "$work/kept" | tar -x -C "$context"
say "context: $(wc -l <"$work/kept") of $(wc -l <"$work/files") files of $revision, $(du -sh "$context" | cut -f1)"

# One instruction per line: comments removed, continued lines joined.
sed -e '/^[[:space:]]*#/d' "$all/Dockerfile" | sed -e ':again' -e '/\\$/{N;s/\\\n[[:space:]]*/ /;b again' -e '}' | sed '/^[[:space:]]*$/d' >"$work/instructions"

root='' folder='' stage=0 variables=() left_out=() health=''

# Maps a path in the image, absolute or below WORKDIR, to a path here.
place() { case $1 in /*) printf '%s' "$root$1" ;; *) printf '%s' "$folder/$1" ;; esac; }

begin_stage() { # image [AS name]
    local name
    stage=$((stage + 1))
    name=$([ "${2:-}" = AS ] && printf '%s' "$3" || printf 'stage%s' "$stage")
    root=$work/stages/$name folder=$root variables=()
    mkdir -p "$root"
    left_out+=("FROM $1 (this machine stands in)")
    case $1 in
        rust:*)
            local wanted=${1#rust:}
            wanted=${wanted%%-*}
            # From the root, where no toolchain file applies: the context has none either.
            case $(cd / && rustc --version) in
                "rustc $wanted."* | "rustc $wanted "*) ;;
                *) die "the Dockerfile builds with Rust $wanted, here is $(cd / && rustc --version)" ;;
            esac ;;
    esac
}

copy() {
    local from=$context
    case $1 in --from=*) from=$work/stages/${1#--from=}; shift ;; --*) die "COPY $1: not known here" ;; esac
    local sources=("${@:1:$#-1}") to source
    to=$(place "${!#}")
    for source in "${sources[@]}"; do
        [ -n "$dry_run" ] && [ "$from" != "$context" ] && continue
        source=$from/${source#/}
        [ -e "$source" ] || die "COPY: ${source#"$work/"} is not there"
        [ -z "$dry_run" ] || continue
        if [ -d "$source" ]; then
            mkdir -p "$to" && cp -a "$source/." "$to/"
        else
            case ${!#} in */) mkdir -p "$to" ;; *) mkdir -p "$(dirname "$to")" ;; esac
            cp -a "$source" "$to"
        fi
    done
}

run() {
    case $1 in apt-get*) left_out+=("RUN $1"); say "   left out"; return ;; esac
    # A path that follows a blank, a quote, = or > and begins with / is outside of the stage's folder.
    if grep -qE "(^|[[:space:]\"'=>])/[[:alnum:]]" <<<"$1"; then die "an absolute path in: RUN $1"; fi
    [ -z "$dry_run" ] || return 0
    (cd "$folder" && env -u CARGO_TARGET_DIR -u RUSTUP_TOOLCHAIN "${variables[@]}" sh -c "$1" </dev/null)
}

while IFS= read -r line; do
    say "== [$SECONDS s] $line"
    word=${line%%[[:space:]]*}
    rest=${line#"$word"}
    rest=${rest#"${rest%%[![:space:]]*}"}
    # Split at blanks, like the instructions below; nothing may expand here.
    read -ra words <<<"$rest"
    case $word in
        FROM) begin_stage "${words[@]}" ;;
        WORKDIR) folder=$root$rest; mkdir -p "$folder" ;;
        ENV) case $rest in *\$*) left_out+=("$line") ;; *) variables+=("${words[@]}") ;; esac ;;
        COPY) copy "${words[@]}" ;;
        RUN) run "$rest" ;;
        HEALTHCHECK) health=${rest#*CMD } ;;
        USER | VOLUME | EXPOSE | ENTRYPOINT | CMD | LABEL) left_out+=("$line") ;;
        *) die "not known here: $line" ;;
    esac
done <"$work/instructions"

say "left out, for an engine to do:"
printf '   %s\n' "${left_out[@]}"
[ -z "$dry_run" ] || { say "dry run: nothing was copied or run"; exit 0; }

binary=$root/opt/uniground/uniground
"$binary" --version
find "$root" -type f -exec du -h {} +
missing=$(ldd "$binary" "$root/opt/uniground/libonnxruntime.so" | grep 'not found' || true)
[ -z "$missing" ] || die "libraries missing: $missing"
# An empty folder and an empty environment: only the library next to the binary can be found.
mkdir "$work/empty"
(cd "$work/empty" && env -i "PATH=$PATH" "$binary" models verify "$all/crates/uniground-models/tests/data/tiny-dual-encoder")

port=$(grep -oE '127\.0\.0\.1/[0-9]+' <<<"$health" | cut -d/ -f2)
if (exec 3<>"/dev/tcp/127.0.0.1/$port") 2>/dev/null; then
    say "the health check is left out: port $port is taken on this machine"
    exit
fi
! sh -c "$health" 2>/dev/null || die "the health check passes without a server"
"$binary" serve --listen "127.0.0.1:$port" --data-dir "$work/data" >"$work/out" 2>"$work/log" &
server=$!
for _ in $(seq 50); do sh -c "$health" 2>/dev/null && healthy=1 && break; sleep 0.2; done
[ -n "${healthy:-}" ] || { cat "$work/log" >&2; die "the health check does not pass"; }
say "healthy: $health"
