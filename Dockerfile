# syntax=docker/dockerfile:1
# Not yet built, see docs/docker.md.
FROM python:3.11-slim AS build
WORKDIR /source
COPY pyproject.toml constraints.txt README.md LICENSE NOTICE ./
COPY licenses licenses
COPY src src
RUN python -m venv /opt/psiamfcpp \
    && /opt/psiamfcpp/bin/pip install --no-cache-dir -c constraints.txt '.[serve,mavlink]'

FROM python:3.11-slim
COPY --from=build /opt/psiamfcpp /opt/psiamfcpp
RUN useradd --create-home --uid 1000 tracker \
    && install -d -o tracker -g tracker /recordings
# Without the last variable onnxruntime sends telemetry, and writes an identifier to the home folder.
ENV PATH=/opt/psiamfcpp/bin:$PATH PYTHONUNBUFFERED=1 ORT_DISABLE_TELEMETRY=1
USER tracker
WORKDIR /home/tracker
VOLUME /recordings
EXPOSE 8000
# Any answer counts, a refusal for a missing token too.
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s --retries=3 CMD ["python", "-c", \
    "import http.client as h; c = h.HTTPConnection('127.0.0.1', 8000, timeout=4); c.request('GET', '/'); c.getresponse()"]
# Ctrl-C, so that recordings are finished
STOPSIGNAL SIGINT
ENTRYPOINT ["psiamfcpp"]
CMD ["serve", "demo"]
