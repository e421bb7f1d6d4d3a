# The command line, x86-64 without an accelerator. Build: make image. Run: docker run --rm --volume "$PWD:/work" \
#     --user "$(id -u)" vslam-env:0.4.0 run --world office --robots 3
FROM python:3.11-slim AS wheels
COPY . /source
RUN pip wheel --no-deps --wheel-dir /wheels /source \
    && pip install --constraint /source/constraints.txt /wheels/*.whl \
    && python -m slam_backend.core.compilation.wheel /wheels slam_backend vslam_env
FROM python:3.11-slim
RUN --mount=type=bind,from=wheels,target=/build useradd --create-home vslam && mkdir /work && chown vslam /work \
    && pip install --no-cache-dir --constraint /build/source/constraints.txt /build/wheels/*.whl
USER vslam
WORKDIR /work
ENTRYPOINT ["vslam"]
