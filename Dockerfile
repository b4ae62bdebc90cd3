# The service in a container: the binary, and ONNX Runtime's library beside it for those who bring models.
#
#   docker build -t uniground .
#   docker run -p 127.0.0.1:8080:8080 -e UNIGROUND_API_KEY=… -v uniground:/data uniground
#
# Bundles of models: -v "$PWD/models:/models:ro"; the server takes what lies there.
#
# scripts/container-steps.sh takes these steps by hand where there is no container engine. For its sake every RUN either
# begins with apt-get (and is left out there) or keeps to paths below its WORKDIR.

# The same Debian as below: a binary wants a C library at least as new as the one it was linked with.
FROM rust:1.95-bookworm AS build
WORKDIR /build
# Dependencies first, over empty packages: this layer is built again only when a manifest or the lockfile changes.
COPY Cargo.toml Cargo.lock ./
COPY crates/uniground-types/Cargo.toml crates/uniground-types/
COPY crates/uniground-geometry/Cargo.toml crates/uniground-geometry/
COPY crates/uniground-ingest/Cargo.toml crates/uniground-ingest/
COPY crates/uniground-models/Cargo.toml crates/uniground-models/
COPY crates/uniground-render/Cargo.toml crates/uniground-render/
COPY crates/uniground-parsing/Cargo.toml crates/uniground-parsing/
COPY crates/uniground-language/Cargo.toml crates/uniground-language/
COPY crates/uniground-grounding/Cargo.toml crates/uniground-grounding/
COPY crates/uniground-export/Cargo.toml crates/uniground-export/
COPY crates/uniground-core/Cargo.toml crates/uniground-core/
COPY crates/uniground-client/Cargo.toml crates/uniground-client/
COPY crates/uniground-telemetry/Cargo.toml crates/uniground-telemetry/
COPY crates/uniground-storage/Cargo.toml crates/uniground-storage/
COPY crates/uniground-jobs/Cargo.toml crates/uniground-jobs/
COPY crates/uniground-isolation/Cargo.toml crates/uniground-isolation/
COPY crates/uniground-endpoints/Cargo.toml crates/uniground-endpoints/
COPY crates/uniground-service/Cargo.toml crates/uniground-service/
COPY crates/uniground-evaluation/Cargo.toml crates/uniground-evaluation/
COPY crates/uniground-testing/Cargo.toml crates/uniground-testing/
# Cargo wants every target that a manifest names to be there, built or not.
RUN for package in . crates/*; do \
        mkdir -p "$package/src" "$package/benches" "$package/tests/integration"; \
        touch "$package/src/lib.rs" "$package/tests/integration/main.rs"; \
        for bench in $(sed -n '/^\[\[bench\]\]/,/^name/ s/^name *= *"\(.*\)"/\1/p' "$package/Cargo.toml"); do touch "$package/benches/$bench.rs"; done; \
    done; \
    echo 'fn main() {}' >src/main.rs \
    && cargo build --release --locked --bin uniground
COPY migrations migrations
COPY examples/living_room.zip examples/
COPY crates crates
COPY src src
COPY web/dist web/dist
# Copied files keep their times and may be older than what was just built: cargo must see that these have changed.
RUN touch src/main.rs src/lib.rs crates/*/src/lib.rs && cargo build --release --locked --bin uniground
# ONNX Runtime from its Python package, checked against its hash.
RUN ./target/release/uniground models fetch --onnxruntime library onnxruntime

FROM debian:bookworm-slim
# ca-certificates for models behind https; libstdc++6 for ONNX Runtime.
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates libstdc++6 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 uniground \
    && mkdir /data && chown uniground /data
COPY --from=build /build/target/release/uniground /opt/uniground/
COPY --from=build /build/library/libonnxruntime.so /opt/uniground/
COPY LICENSE-MIT LICENSE-APACHE crates/uniground-render/assets/fonts/OFL.txt /opt/uniground/licences/
COPY src/packages/bundles/clip-vitb16-lite/PROVENANCE.md /opt/uniground/licences/clip-vitb16-lite.md
COPY --from=build /build/library/LICENSE /build/library/NOTICES /opt/uniground/licences/onnxruntime/
# Any address but loopback wants a key: pass UNIGROUND_API_KEY.
ENV PATH=/opt/uniground:$PATH UNIGROUND_LISTEN=0.0.0.0:8080 UNIGROUND_DATA_DIR=/data UNIGROUND_MODELS=/models
USER 10001
VOLUME /data
EXPOSE 8080
# bash opens the connection itself: no other program is needed.
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s \
    CMD bash -c 'exec 3<>/dev/tcp/127.0.0.1/8080 && printf "GET /readyz HTTP/1.0\r\n\r\n" >&3 && read -r _ status _ <&3 && test "$status" = 200'
ENTRYPOINT ["uniground"]
CMD ["serve"]
