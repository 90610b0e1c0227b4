# Without a GPU:   docker build -t ebarf .
# For NVIDIA GPUs: docker build -t ebarf --build-arg BASE=nvidia/cuda:12.8.1-base-ubuntu24.04 .
#                  (torch bundles its CUDA libraries; the host needs the NVIDIA container toolkit)
# Train on scenes in the current folder:
#   docker run --rm -it --gpus all -p 7007:7007 -v "$PWD:/home/ebarf/data" ebarf \
#     ebarf train data/scene --output-dir data/runs --viewer.websocket-host 0.0.0.0
ARG BASE=debian:bookworm-slim
FROM ${BASE}

# ffmpeg for ns-render, libusb for ns-export's open3d, a compiler for Triton's launcher and for dependencies without a
# wheel.
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
        build-essential ffmpeg git libegl1 libgl1 libgomp1 libusb-1.0-0 libx11-6 python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home ebarf
USER ebarf
WORKDIR /home/ebarf

COPY --chown=ebarf pyproject.toml constraints.txt README.md LICENSE source/
COPY --chown=ebarf ebarf_ns source/ebarf_ns
RUN python3 -m venv venv \
    && venv/bin/pip install --no-cache-dir --constraint source/constraints.txt ./source
ENV PATH=/home/ebarf/venv/bin:$PATH

EXPOSE 7007
CMD ["ebarf", "--help"]
