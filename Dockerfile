# docker build -t devrf . && docker run --rm -v "$PWD/outputs:/home/outputs" devrf    # the quickstart
FROM python:3.12-slim
# torch's CPU build; for a GPU: --build-arg PIP_EXTRA_INDEX_URL= (and docker run --gpus all)
ARG PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
COPY pyproject.toml constraints.txt README.md LICENSE /devrf/
COPY src /devrf/src
COPY conf /devrf/conf
RUN pip install --no-cache-dir --constraint /devrf/constraints.txt /devrf
WORKDIR /home
ENTRYPOINT ["devrf"]
