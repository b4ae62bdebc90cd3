# Build: docker build -t uniground .
# Run:   docker run -p 8080:8080 -e UNIGROUND_API_KEY=… -v uniground:/data uniground
FROM rust:1.95-bookworm AS build
WORKDIR /src
COPY . .
RUN cargo build --release --locked

FROM debian:bookworm-slim
RUN apt-get update && apt-get install -y --no-install-recommends curl && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 uniground && mkdir /data && chown uniground /data
COPY --from=build /src/target/release/uniground /usr/local/bin/uniground
USER uniground
VOLUME /data
EXPOSE 8080
# Any address but loopback wants a key: pass UNIGROUND_API_KEY.
ENV UNIGROUND_LISTEN=0.0.0.0:8080 UNIGROUND_DATA_DIR=/data
HEALTHCHECK --interval=10s --timeout=3s --start-period=5s CMD curl -fsS http://127.0.0.1:8080/readyz || exit 1
ENTRYPOINT ["uniground"]
CMD ["serve"]
