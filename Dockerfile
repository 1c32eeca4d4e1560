# RMC on the CPU: docker build -t rmc .
# tests/packaging/in_container.py repeats these steps without Docker; it knows no other instructions than these.
FROM python:3.11-slim

# Where torch without CUDA comes from; a mirror or a folder of wheels does, too.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PATH=/opt/rmc/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
ENV PIP_NO_CACHE_DIR=1 PYTHONDONTWRITEBYTECODE=1

RUN python3 -m venv /opt/rmc
COPY constraints.txt /src/
RUN /opt/rmc/bin/pip install --quiet torch==2.13.0 --extra-index-url "$TORCH_INDEX" -c /src/constraints.txt
COPY . /src/
RUN /opt/rmc/bin/pip install --quiet /src -c /src/constraints.txt \
    && rm -rf /src \
    && useradd --uid 1000 --create-home rmc \
    && mkdir /work \
    && chown rmc /work

# For users whom the image does not know.
ENV HOME=/work
USER rmc
WORKDIR /work
ENTRYPOINT ["rmc"]
