# The commands of pointsplat_ns on a CPU, but for those that train, which need nerfstudio:
#   docker build -t pointsplat .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" pointsplat prune room.ply --keep 10%

FROM python:3.11-slim AS build
# The compiler of the rasterizer's kernels.
RUN apt-get update && apt-get install --no-install-recommends -y g++
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
# Builds of torch and torchvision without CUDA, both from one index, as they have to fit each other.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir --index-url "$TORCH_INDEX" torch torchvision
WORKDIR /source
COPY pyproject.toml setup.py README.md LICENSE ./
COPY pointsplat_ns pointsplat_ns
COPY method_configs method_configs
RUN pip install --no-cache-dir .

FROM python:3.11-slim
RUN apt-get update \
    && apt-get install --no-install-recommends -y libgomp1 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/venv /opt/venv
# Threads that wait for one another spin briefly and then sleep; what is downloaded goes where any user may write.
ENV PATH=/opt/venv/bin:$PATH \
    GOMP_SPINCOUNT=20000 \
    HOME=/tmp
RUN pointsplat --version
WORKDIR /data
ENTRYPOINT ["pointsplat"]
CMD ["--help"]
