# syntax=docker/dockerfile:1
# The image for machines without a GPU: the package, its command, the reference node.
#
#   docker build -t warploom:cpu .
#   docker run --rm warploom:cpu demo --seconds 5 --out /tmp/demo
#   docker run --rm --shm-size=1g warploom:cpu start-all computing_node_hw50_pandar90_13_600

FROM python:3.12-slim-bookworm AS build
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
# The requirements by themselves first: they change less often than the code, so that this layer is kept.
RUN python -m venv /opt/warploom \
 && python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb'))['project']; print('\n'.join([*p['dependencies'], *p['optional-dependencies']['net']]))" > requirements.txt \
 && /opt/warploom/bin/pip install --no-cache-dir --constraint constraints.txt --requirement requirements.txt
COPY . .
RUN /opt/warploom/bin/pip install --no-cache-dir --constraint constraints.txt --no-deps .

FROM python:3.12-slim-bookworm
LABEL org.opencontainers.image.title="warploom" \
      org.opencontainers.image.description="Perception for vehicles and robots: LiDAR points to tracked objects, on the CPU" \
      org.opencontainers.image.licenses="Apache-2.0"
COPY --from=build /opt/warploom /opt/warploom
RUN useradd --system --uid 10001 --user-group --create-home --home-dir /var/lib/warploom warploom \
 && install --directory --owner=warploom --mode=0700 /run/warploom
ENV PATH=/opt/warploom/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    WARPLOOM_RUN=/run/warploom \
    WARP_CACHE_PATH=/var/lib/warploom/kernels
USER 10001:10001
WORKDIR /var/lib/warploom
# Kernels are compiled here, so that the first frame in a container finds them.
RUN warploom demo --seconds 0.5 --out /tmp/demo \
 && rm -r /tmp/demo
STOPSIGNAL SIGTERM
# In a container without a node, such as one that runs a demo, there is nothing that could be sick.
HEALTHCHECK --interval=30s --timeout=10s --start-period=300s \
  CMD ["sh", "-c", "! ls /run/warploom/*/control.sock > /dev/null 2>&1 || warploom ps --json > /dev/null"]
ENTRYPOINT ["warploom"]
CMD ["demo", "--out", "/tmp/demo"]
