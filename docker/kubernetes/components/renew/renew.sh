#!/bin/sh
# Makes certificates again that end soon, puts them into their secrets, and restarts who uses them. In the pod of renew.yaml:
# /authority is the secret caudata-authority (ca.crt, ca.key), /pki is empty.
set -eu
roles=${ROLES:-"learner actor server router"}
pki=${PKI:-/pki}
install -m 0600 "${AUTHORITY:-/authority}/ca.key" "$pki/ca.key"
install -m 0644 "${AUTHORITY:-/authority}/ca.crt" "$pki/ca.crt"
fetch() { # ROLE FILE
    kubectl get secret "caudata-$1-tls" -o "go-template={{index .data \"$2\"}}" | base64 -d
}
for role in $roles; do
    kubectl get secret "caudata-$role-tls" > /dev/null 2>&1 || continue
    mkdir -p "$pki/$role"
    for file in ca.crt tls.crt tls.key; do
        (umask 077 && fetch "$role" "$file" > "$pki/$role/$file")
    done
    cp "$pki/$role/tls.crt" "$pki/$role.before"
done
caudata pki renew --dir "$pki"
for role in $roles; do
    [ -e "$pki/$role.before" ] || continue
    ! cmp -s "$pki/$role.before" "$pki/$role/tls.crt" || continue
    kubectl create secret generic "caudata-$role-tls" --from-file="$pki/$role" --dry-run=client -o yaml | kubectl apply -f -
    case $role in
        actor | router) kubectl rollout restart "deployment/caudata-$role" ;;
        server) kubectl rollout restart statefulset/caudata-policy-server ;;
        *) kubectl rollout restart "statefulset/caudata-$role" ;;
    esac
done
