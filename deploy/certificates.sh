#!/bin/sh
# Make a throw-away certificate authority and one certificate for scheduler, workers and clients of one Dask cluster:
#   sh certificates.sh FOLDER && . FOLDER/tls.env
# Whoever holds node.key can use the cluster, so FOLDER is private (0700) and the key 0600. Valid for 30 days.
set -eu
folder=$1
umask 077
mkdir -p "$folder"
cd "$folder"
folder=$(pwd)
openssl req -x509 -newkey rsa:2048 -nodes -keyout ca.key -out ca.pem -days 30 -subj "/CN=ppdf-dask ca" 2>/dev/null
openssl req -newkey rsa:2048 -nodes -keyout node.key -out node.csr -subj "/CN=ppdf-dask node" 2>/dev/null
openssl x509 -req -in node.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 30 -out node.pem 2>/dev/null
# Nothing more is to be signed.
rm -f ca.key node.csr
{
  echo "export DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION=true"
  echo "export DASK_DISTRIBUTED__COMM__TLS__CA_FILE='$folder/ca.pem'"
  for role in SCHEDULER WORKER CLIENT; do
    echo "export DASK_DISTRIBUTED__COMM__TLS__${role}__CERT='$folder/node.pem'"
    echo "export DASK_DISTRIBUTED__COMM__TLS__${role}__KEY='$folder/node.key'"
  done
} > tls.env
